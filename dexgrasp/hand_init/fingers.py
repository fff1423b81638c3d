"""Which chains are fingers, what they are called, and where their tips are."""

import re
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.anatomy import Anatomy, Chain
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Joint, Model

FINGER_WORDS = ("thumb", "index", "middle", "ring", "little", "pinky", "pinkie")
SHORT_WORDS = {"th": "thumb", "ff": "index", "mf": "middle", "rf": "ring", "lf": "little", "if": "index"}
WIDEST = {"revolute": 4.2, "prismatic": 0.3}
"""No finger joint moves farther, rad or m: a range beyond stands for none."""
FOLLOWED, LINKED = 0.012, 0.03
"""A link that stays this near to a longer finger's links is a part of its linkage, m; in a closed loop with it."""


@dataclass
class FingerGuess:
    """A finger as it was found."""

    name: str
    chain: Chain
    link: str
    """The distal link: of those fixed behind the last joint the one that holds the tip."""
    tip: Float[ndarray, "3"]
    """A point at the end of the tip, in the coordinates of the link that the last joint moves, m."""
    drivers: list[str]
    """Independent joints that move it."""
    closing: dict[str, float] = field(default_factory=dict)

    @property
    def last(self) -> Joint:
        """The joint that carries the distal link."""
        return self.chain.joints[-1]


def find_fingers(anatomy: Anatomy, guesses: Guesses) -> list[FingerGuess]:
    """Return the chains that are fingers.

    Raises DexgraspError where fewer than two are left.
    """
    model, fingers = anatomy.model, []
    file = list(model.joints)
    for chain in sorted(anatomy.chains, key=lambda chain: file.index(chain.joints[-1].name)):
        drivers = list(dict.fromkeys(model.driver(joint.name).joint for joint in chain.joints))
        drivers = [joint.name for joint in model.free if joint.name in drivers]
        link, tip = _tip(anatomy, chain, guesses)
        fingers.append(FingerGuess(link, chain, link, tip, drivers))
    fingers = _without_followers(anatomy, fingers, guesses)
    if len(fingers) < 2:
        raise DexgraspError(
            f"two fingers or more in {model.path}",
            f"{len(fingers)}: {', '.join(finger.name for finger in fingers)}",
            "a hand needs at least two links that move by themselves",
        )
    for finger, name in zip(fingers, _names([finger.chain for finger in fingers]), strict=True):
        finger.name = name
    return fingers


def tip_positions(
    model: Model, fingers: list[FingerGuess], values: dict[str, Float[ndarray, "N"]]
) -> Float[ndarray, "N F 3"]:
    """Return where the tips are, root coordinates, m."""
    poses = model.poses(values)
    return np.stack([poses[f.last.child][:, :3, :3] @ f.tip + poses[f.last.child][:, :3, 3] for f in fingers], axis=1)


def span(joint: Joint) -> tuple[float, float]:
    """Return the range of a joint, or what is tried where it has none."""
    if joint.upper - joint.lower < WIDEST[joint.kind]:
        return joint.lower, joint.upper
    return (-0.05, 0.05) if joint.kind == "prismatic" else (-np.pi / 2, np.pi / 2)


def middle(model: Model) -> dict[str, Float[ndarray, "1"]]:
    """Return the posture with every independent joint in the middle of its range."""
    return {joint.name: np.array([sum(span(joint)) / 2]) for joint in model.free}


def group_mesh(model: Model, chain: Chain) -> trimesh.Trimesh | None:
    """Return the shapes that the last joint carries, in the coordinates of the link that it moves."""
    first, meshes = chain.joints[-1].child, []
    poses = model.poses({})
    for name in chain.links:
        mesh = model.links[name].mesh
        if mesh is not None:
            mesh = mesh.copy()
            mesh.apply_transform(np.linalg.inv(poses[first][0]) @ poses[name][0])
            meshes.append(mesh)
    return trimesh.util.concatenate(meshes) if meshes else None  # type: ignore[return-value]


def _tip(anatomy: Anatomy, chain: Chain, guesses: Guesses) -> tuple[str, np.ndarray]:
    """Return the distal link and a point at its end."""
    model, last = anatomy.model, chain.joints[-1]
    mesh = group_mesh(model, chain)
    assert mesh is not None, "chains end in links that have a shape"
    points = np.asarray(mesh.vertices)
    if last.kind == "revolute":
        far = np.linalg.norm(points - np.outer(points @ last.axis, last.axis), axis=1)
    else:
        pose = model.poses(middle(model))
        palm = pose[anatomy.palm[0]][0, :3, 3]
        centers = [pose[name][0] for name in anatomy.palm if model.links[name].mesh is not None]
        if centers:
            palm = np.mean([c[:3, :3] @ model.links[n].mesh.centroid + c[:3, 3] for c, n in  # type: ignore[union-attr]
                            zip(centers, [n for n in anatomy.palm if model.links[n].mesh is not None], strict=True)],
                           axis=0)  # fmt: skip
        own = pose[last.child][0]
        way = own[:3, :3].T @ (own[:3, :3] @ mesh.centroid + own[:3, 3] - palm)
        way -= (way @ last.axis) * last.axis
        far = points @ (way / max(float(np.linalg.norm(way)), 1e-9))
    end = points[far >= far.max() - 0.1 * np.ptp(far)]
    tip = end.mean(axis=0)
    return _distal(model, chain, tip, guesses), tip


def _distal(model: Model, chain: Chain, tip: np.ndarray, guesses: Guesses) -> str:
    """Return the link behind the last joint that holds the tip; tiny ones (sensors, markers) do not count."""
    first, poses = chain.joints[-1].child, model.poses({})
    nearest: list[tuple[float, str]] = []
    for name in chain.links:
        mesh = model.links[name].mesh
        if mesh is None or mesh.extents.max() < 0.006:
            continue
        place = np.linalg.inv(poses[first][0]) @ poses[name][0]
        points = mesh.vertices @ place[:3, :3].T + place[:3, 3]
        nearest.append((float(np.linalg.norm(points - tip, axis=1).min()), name))
    link = min(nearest)[1] if nearest else first
    if link != first:
        guesses.add(
            f"fingers.{link}", f"{link}, fixed to {first}, is the distal link: it holds the end of the finger", "likely"
        )
    return link


def _without_followers(anatomy: Anatomy, fingers: list[FingerGuess], guesses: Guesses) -> list[FingerGuess]:
    """Take out what a finger's motor moves as well: links of its linkage, pulleys."""
    model = anatomy.model
    values = {joint.name: np.linspace(*span(joint), 5) for joint in model.free}
    tips = tip_positions(model, fingers, values)
    travel = np.linalg.norm(np.diff(tips, axis=0), axis=-1).sum(axis=0)
    bases = np.mean([f.chain.joints[0].origin[:3, 3] for f in fingers], axis=0)
    reach = np.linalg.norm(tips - bases, axis=-1).max(axis=0)
    poses = model.poses(values)
    trees = [_points(model, finger, poses) for finger in fingers]
    kept = []
    for i, finger in enumerate(fingers):
        reason = "its tip does not move" if travel[i] < 0.004 else ""
        for j, other in enumerate(fingers):
            longer = len(other.chain.joints) > len(finger.chain.joints)
            linked = finger.last.looped and other.last.looped and reach[j] > reach[i]
            if not (longer or linked) or reason or not set(finger.drivers) <= set(other.drivers):
                continue
            apart = max(float(cKDTree(trees[j][k]).query(tips[k, i])[0]) for k in range(len(tips)))
            near = apart < (LINKED if linked else FOLLOWED)
            if travel[i] < 0.4 * travel[j] or near:
                reason = f"it is moved with {other.name}, {'and keeps to its links' if near else 'far less'}"
        if reason:
            guesses.add("fingers", f"{finger.link} is no finger: {reason}", "likely")
        else:
            kept.append(finger)
    return kept


def _points(model: Model, finger: FingerGuess, poses: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Return surface points of all links of a finger in each posture."""
    links = [joint.child for joint in finger.chain.joints] + finger.chain.links
    found: list[list[np.ndarray]] = [[] for _ in range(len(next(iter(poses.values()))))]
    for name in dict.fromkeys(links):
        mesh = model.links[name].mesh
        if mesh is None:
            continue
        points = trimesh.sample.sample_surface(mesh, 400, seed=0)[0]
        for k, pose in enumerate(np.broadcast_to(poses[name], (len(found), 4, 4))):
            found[k].append(points @ pose[:3, :3].T + pose[:3, 3])
    return [np.vstack(points) if points else np.zeros((1, 3)) for points in found]


def _names(chains: list[Chain]) -> list[str]:
    """Name fingers by the words in their links' and joints' names, else by what tells those apart, else by number."""
    found = []
    for chain in chains:
        words = [w for joint in chain.joints for w in (joint.name, joint.child)] + chain.links
        tokens = {token for word in words for token in _tokens(word)}
        hits = [word for word in FINGER_WORDS if any(word in token for token in tokens)]
        if len(chains) > 2:  # the jaws lf and rf of a gripper are no little and ring finger
            hits = hits or [
                word for short, word in SHORT_WORDS.items() if short in {t.removesuffix("j") for t in tokens}
            ]
        found.append(hits[0] if len(hits) == 1 else "")
    if "" not in found and len(set(found)) == len(found):
        return found
    last = [_tokens(chain.joints[-1].child) for chain in chains]
    own = ["_".join(t for t in tokens if not all(t in other for other in last)) for tokens in last]
    if len(set(own)) == len(own) and all(re.fullmatch(r"[a-z][a-z0-9_]{0,19}", name) for name in own):
        return own
    numbers = sorted(int(name) for name in own if name.isdigit())
    if len(set(own)) == len(own) and numbers in (list(range(len(own))), list(range(1, len(own) + 1))):
        return [f"finger_{name}" for name in own]
    return [f"finger_{i + 1}" for i in range(len(chains))]


def _tokens(name: str) -> list[str]:
    """Return the words and numbers of a name."""
    return re.findall(r"[a-z]+|[0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
