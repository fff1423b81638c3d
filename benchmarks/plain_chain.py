"""The chain as it is written with libraries alone: FCL closes the fingers, qhull judges; ours only draws and places."""

import time

import fcl
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from benchmarks.closing import Scan, fcl_model
from dexgrasp.collision import as_arrays
from dexgrasp.dataset.proposals import Approach, Contact
from dexgrasp.dataset.surface import Surface
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.distance import DistanceField
from dexgrasp.hand_body import hand_body, place_links
from dexgrasp.objects import Object
from dexgrasp.quality import wrenches
from dexgrasp.urdf import UrdfHand

STRIDE = 1e-3
"""Of the scan, m."""
TOUCH = 1e-4
"""Distal links no farther from the object touch it, m."""


class PlainChain:
    """Draws, closes and judges candidates on one object, one at a time."""

    def __init__(self, hand: UrdfHand, item: Object, settings: SynthesisSettings) -> None:
        self.hand, self.item, self.settings, self.body = hand, item, settings, hand_body(hand)
        self.scan = Scan(hand, self.body, item.mesh)
        self.parts = [
            (link, fcl.CollisionObject(fcl_model(part)))
            for link, record in enumerate(hand.tree)
            for part in hand.collisions.get(record.name, ())
        ]
        self.surface = Surface.sample(item, DistanceField.build(item.mesh), settings.spacing, np.random.default_rng(0))

    def run(self, count: int, seed: int) -> tuple[int, float]:
        """Try so many candidates; return how many are valid and the processor time that it took, s."""
        rng = np.random.default_rng(seed)
        few = round(self.settings.approach * count)
        drawn = []
        for proposer, part in ((Approach(self.hand), few), (Contact(self.hand), count - few)):
            drawn.append(as_arrays(*proposer.hands(self.surface, proposer.draw(self.surface, part, rng))))
        began, valid = time.process_time(), 0
        for poses, joints in drawn:
            valid += sum(self._valid(pose, posture) for pose, posture in zip(poses, joints, strict=True))
        return valid, time.process_time() - began

    def _valid(self, pose: np.ndarray, joints: np.ndarray) -> bool:
        full, placed = np.empty(len(self.body.offset)), self.scan.poses
        place_links(self.body, joints, pose, full, placed)
        for link, part in self.parts:
            self._move(part, placed[link])
            if fcl.collide(part, self.scan.object, self.scan.ask, fcl.CollisionResult()):
                return False
        full = self.scan.close(pose, joints, STRIDE)
        contacts, normals = [], []
        for finger, tip in enumerate(self.body.tip_links):
            found = self._contact(pose, full, finger, int(tip))
            if found is None:
                return False
            contacts.append(found[0])
            normals.append(found[1])
        settings = self.settings
        told = wrenches(
            np.array([contacts]),
            np.array([normals]),
            self.item.com,
            self.item.radius,
            settings.friction,
            settings.edges,
        )
        try:
            hull = ConvexHull(told[0], qhull_options="QJ")
        except QhullError:
            return False
        return bool(-hull.equations[:, -1].max() >= settings.epsilon)

    def _contact(
        self, pose: np.ndarray, full: np.ndarray, finger: int, tip: int
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return point and outward normal where a distal link touches the object."""
        self.scan.place(pose, full, finger)
        best = (TOUCH, None, None)
        for link, part in self.scan.fingers[finger][1]:
            if link != tip:
                continue
            self._move(part, self.scan.poses[link])
            result = fcl.DistanceResult()
            request = fcl.DistanceRequest(enable_nearest_points=True)
            if fcl.distance(part, self.scan.object, request, result) < best[0]:
                best = (result.min_distance, result.nearest_points[1], self.item.mesh.face_normals[result.b2])
        return None if best[1] is None else (np.asarray(best[1]), np.asarray(best[2]))

    @staticmethod
    def _move(part: fcl.CollisionObject, placed: np.ndarray) -> None:
        part.setTransform(fcl.Transform(placed[:, :3], placed[:, 3]))
