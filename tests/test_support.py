import pytest
import torch

from dexgrasp.grasps import Grasps
from dexgrasp.support import support


def grasps(places, objects, qualities) -> Grasps:
    pose = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    pose[:, 0, 3] = torch.tensor(places, dtype=torch.float64)
    made = Grasps.build(pose, torch.zeros(len(places), 4).double(), 3, quality=torch.tensor(qualities).double())
    return made.replace(object=torch.tensor(objects))


def backed(of: Grasps) -> torch.Tensor:
    return support(of, of.quality)


def test_alone_it_is_its_own():
    far = grasps([0.0, 10.0], [0, 0], [0.3, 0.7])
    torch.testing.assert_close(backed(far), far.quality)


def test_grasps_alike_back_each_other():
    worth = backed(grasps([0.0, 0.002, 0.004, 0.5], [0, 0, 0, 0], [0.1, 0.1, 0.1, 0.2]))
    assert worth.argmax() == 1
    assert float(worth[3]) == pytest.approx(0.2)
    assert worth[1] > worth[3]


def test_with_doubt_many_poor_grasps_are_no_good_one():
    near = grasps([0.0] * 8 + [5.0] * 2, [0] * 10, [0.3] * 8 + [0.9] * 2)
    summed, mean = support(near, near.quality), support(near, near.quality, 2.0)
    assert summed.argmax() < 8 and mean.argmax() >= 8
    torch.testing.assert_close(mean, torch.tensor([8 * 0.3 / 10] * 8 + [2 * 0.9 / 4] * 2).double())
    lonely = grasps([0.0, 5.0, 5.0, 5.0], [0] * 4, [0.9, 0.8, 0.8, 0.8])
    assert support(lonely, lonely.quality, 2.0).argmax() > 0


def test_objects_do_not_back_each_other():
    apart = backed(grasps([0.0, 0.0], [0, 1], [0.1, 0.2]))
    torch.testing.assert_close(apart, torch.tensor([0.1, 0.2]).double())
    together = backed(grasps([0.0, 0.0], [0, 0], [0.1, 0.2]))
    torch.testing.assert_close(together, torch.tensor([0.3, 0.3]).double())


def test_a_turned_or_opened_hand_is_another_grasp():
    two = grasps([0.0, 0.0], [0, 0], [0.1, 0.1])
    turned = two.pose.clone()
    turned[1, :3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    opened = two.joints.clone()
    opened[1] = 1.0
    assert backed(two.replace(pose=turned)).max() < 0.11
    assert backed(two.replace(joints=opened)).max() < 0.11
