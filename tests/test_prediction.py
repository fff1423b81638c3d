"""Grasps of a scene: of its objects, clear of what was seen, fingers closed on it; and how they are told."""

import json

import numpy as np
import pytest
import torch

from dexgrasp import offer
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.grasps import Grasps
from dexgrasp.interchange.formats import read_grasps
from dexgrasp.prediction import Predicted, close_on, predict_sight
from dexgrasp.selection import Selection
from dexgrasp.sight import Sight

DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
HALF = 0.03


def cube() -> Sight:
    """A 6 cm cube on a table as a camera sees it that looks straight down from 60 cm, every side of it."""
    side = np.arange(-HALF, HALF + 1e-9, 0.003)
    a, b = (each.reshape(-1) for each in np.meshgrid(side, side))
    walls, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points, normal = np.zeros((len(a), 3)), np.zeros(3)
            points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = sign * HALF, a, b
            normal[axis] = sign
            walls.append(points + np.array([0.0, 0.0, HALF]))
            normals.append(np.tile(normal, (len(points), 1)))
    floor = np.stack([each.reshape(-1) for each in np.meshgrid(*[np.arange(-0.2, 0.2, 0.004)] * 2)], axis=1)
    floor = floor[(np.abs(floor) > HALF).any(axis=1)]
    points = np.concatenate([*walls, np.column_stack([floor, np.zeros(len(floor))])])
    directions = np.concatenate([*normals, np.tile([0.0, 0.0, 1.0], (len(floor), 1))])
    labels = np.where(np.arange(len(points)) < 6 * len(a), 0, -1)
    camera_T_table = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_T_table[2, 3] = 0.6
    move = camera_T_table[:3, :3].T
    return Sight(
        points @ move + camera_T_table[:3, 3], directions @ move, labels, np.linalg.inv(camera_T_table), np.eye(4)
    )


class Told:
    """A network that always tells the same grasps, in the level frame."""

    def __init__(self, hand, grasps):
        self.hand, self.grasps, self.points, self.selection = hand, grasps, 2048, Selection(depth=0.003)

    def parameters(self):
        yield torch.zeros(1)

    def propose(self, level):
        return self.grasps

    def selecting(self, selection=None):
        return selection or self.selection


def above(hand, heights, joints, turns=(0.0,)) -> Grasps:
    """Grasps straight from above, in the level frame of `cube`; heights of the base above the table."""
    poses = []
    for height in heights:
        for turn in turns:
            rotation = axis_angle(torch.tensor([0.0, 0, 1]).double(), torch.tensor(turn).double()) @ DOWN[:3, :3]
            poses.append(pose(rotation, torch.tensor([0.0, 0, height]).double()))
    count = len(poses)
    grasps = Grasps.build(
        torch.stack(poses).float(), torch.tensor([joints]).expand(count, -1).contiguous(), len(hand.fingers),
        quality=torch.linspace(0.9, 0.5, count),
    )  # fmt: skip
    return grasps


@pytest.fixture(scope="module")
def predicted(hand) -> Predicted:
    # Straight above; too low (palm in the cube); beside it, where nothing is.
    grasps = above(hand, (0.2, 0.12), [0.0, 1.25, 1.25, 1.25])
    beside = grasps[[0]].replace(pose=grasps.pose[[0]] + torch.tensor([[0, 0, 0, 0.15], [0] * 4, [0] * 4, [0] * 4]))
    return predict_sight(Told(hand, Grasps.cat([grasps, beside])), cube(), top_k=5)  # type: ignore[arg-type]


def test_only_what_is_clear_and_at_an_object_is_offered(predicted):
    assert len(predicted.grasps) == 1 and float(predicted.grasps.quality[0]) == pytest.approx(0.9)
    assert predicted.grasps.object.tolist() == [0]


def test_fingers_end_on_the_surface(hand, shape, predicted):
    sight, grasps = predicted.sight, predicted.grasps
    assert bool(grasps.contacts.isfinite().all())
    table = torch.from_numpy(sight.table_T_camera)
    contacts = grasps.moved(table).contacts[0].double()
    assert (contacts[:, :2].abs().max(dim=1).values - HALF).abs().max() < 1e-3  # on the cube's sides
    normals = grasps.moved(table).normals[0].double()
    assert (normals[:, 2].abs() < 0.1).all() and ((normals * contacts)[:, :2].sum(1) > 0).all()
    depth = shape.cloud_depth(torch.from_numpy(sight.points), grasps.pose.double(), grasps.joints.double())
    assert float(depth.max()) < 0.003


def test_a_finger_that_meets_nothing_stays_as_predicted(hand):
    sight = cube()
    grasps = above(hand, (0.5,), [0.0, 0.9, 0.9, 0.9]).moved(torch.from_numpy(np.linalg.inv(sight.table_T_camera)))
    closed = close_on(hand, grasps, sight)
    assert torch.equal(closed.joints, grasps.joints) and not closed.contacts.isfinite().any()


def test_pregrasps_stand_back_and_are_open(hand, predicted):
    back = (predicted.pregrasp_pose[0] - predicted.grasps.pose[0])[:3, 3].norm()
    assert float(back) == pytest.approx(0.1, abs=1e-5)
    assert (predicted.pregrasp_joints[0, 1:] < predicted.grasps.joints[0, 1:] - 0.3).all()


def test_objects_that_are_not_there_are_refused(hand):
    model, sight = Told(hand, above(hand, (0.2,), [0.0, 1.25, 1.25, 1.25])), cube()
    with pytest.raises(DexgraspError, match="an object from 0 to 0"):
        predict_sight(model, sight, target=1)  # type: ignore[arg-type]
    empty = Sight(sight.points, sight.normals, np.full(len(sight.points), -1), sight.table_T_camera, np.eye(4))
    with pytest.raises(DexgraspError, match="objects that stand out of the table"):
        predict_sight(model, empty)  # type: ignore[arg-type]


def test_told_in_the_robots_frame_for_its_flange(tmp_path, hand, predicted):
    turn = axis_angle(torch.tensor([0.0, 0.6, 0.8]).double(), torch.tensor(1.1).double())
    base_T_camera = pose(turn, torch.tensor([0.4, -0.1, 0.7]).double())
    flange_T_hand = pose(turn.T, torch.tensor([0.0, 0.02, 0.05]).double())
    row = offer.told(predicted, hand, base_T_camera, flange_T_hand)[0]
    json.dumps(row, allow_nan=False)
    hand_pose = torch.tensor(row["pose"]["matrix"], dtype=torch.float64)
    torch.testing.assert_close(hand_pose, base_T_camera @ predicted.grasps.pose[0].double(), atol=1e-6, rtol=0)
    for where in (row, row["pregrasp"]):
        flange = torch.tensor(where["flange_pose"]["matrix"], dtype=torch.float64)
        of_hand = torch.tensor(where["pose"]["matrix"], dtype=torch.float64)
        torch.testing.assert_close(flange @ flange_T_hand, of_hand, atol=1e-6, rtol=0)
    w, x, *_ = row["pose"]["quaternion"]
    assert w >= 0 and hand_pose[2, 1] - hand_pose[1, 2] == pytest.approx(4 * w * x, abs=1e-5)
    assert list(row["joints"]) == list(hand.joint_names) and len(row["contacts"]) == 3
    path = offer.write_isaac(tmp_path / "grasps.yaml", predicted, hand, base_T_camera, "base")
    back = read_grasps(path)
    np.testing.assert_allclose(back.grasp.pose[0], hand_pose.numpy(), atol=1e-6)
    assert back.joint_names == hand.joint_names and back.objects == ("base",)


def test_a_picture_is_drawn(tmp_path, hand, predicted):
    from PIL import Image

    image = np.asarray(Image.open(offer.draw(tmp_path / "grasps.png", predicted, hand)).convert("L"))
    assert image.shape[1] > 500 and (image < 100).mean() > 0.005  # the hand is dark
