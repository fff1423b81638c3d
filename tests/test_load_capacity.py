"""Load capacity beside a library's linear programming, and beside what one can work out by hand."""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from dexgrasp.contact_wrenches import compiled_wrenches, cone_edges
from dexgrasp.errors import DexgraspError
from dexgrasp.load_capacity import Load, capacities, normal_forces
from dexgrasp.plugins import load_hand

UP = np.array([0.0, 0, 1, 0, 0, 0])


def pinch(friction: float, limit: float, edges: int = 8) -> float:
    contacts, normals = np.array([[[1.0, 0, 0], [-1, 0, 0]]]), np.array([[[1.0, 0, 0], [-1, 0, 0]]])
    wrenches = compiled_wrenches(contacts, normals, np.zeros(3), 1.0, friction, 0.0, cone_edges(edges, False))
    return float(capacities(wrenches, np.full((1, 2), limit), UP)[0])


def test_two_fingers_hold_twice_the_friction() -> None:
    assert pinch(0.5, 10.0, 8) == pytest.approx(2 * 0.5 * 10.0)
    assert pinch(0.0, 10.0) == 0


@pytest.mark.parametrize(("contacts", "torsion"), [(3, 0.0), (2, 0.02), (3, 0.02), (5, 0.02)])
def test_agrees_with_a_library(contacts: int, torsion: float) -> None:
    draw = np.random.default_rng(contacts)
    points = draw.normal(size=(60, contacts, 3))
    points -= points.mean(axis=1, keepdims=True)
    normals = points + draw.normal(scale=0.2, size=points.shape)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    cone, limits = cone_edges(8, torsion > 0), draw.uniform(1, 5, size=(60, contacts))
    wrenches = compiled_wrenches(points * 0.04, normals, np.zeros(3), 0.05, 0.5, torsion, cone)
    found = capacities(wrenches, limits, UP)
    owner = np.repeat(np.eye(contacts), len(cone), axis=1)
    wanted = []
    for each, limit in zip(wrenches, limits, strict=True):
        result = linprog(
            np.r_[-1.0, np.zeros(len(each))],
            A_ub=np.c_[np.zeros(contacts), owner],
            b_ub=limit,
            A_eq=np.c_[-UP, each.T],
            b_eq=np.zeros(6),
        )
        wanted.append(result.x[0])
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert (found > 0).any()


def test_a_finger_that_does_not_touch_holds_nothing() -> None:
    hand = load_hand("barrett")
    joints = torch.zeros(1, len(hand.joint_names)).double()
    base, nothing = torch.eye(4).double()[None], torch.full((1, len(hand.fingers), 3), float("nan")).double()

    class Ball:
        com, radius, volume = np.zeros(3), 0.04, 2.7e-4

    assert Load().capacity(hand, Ball(), base, joints, nothing, nothing, torch.tensor([0.0, 0, 1])).tolist() == [0.0]


def test_forces_follow_from_efforts_and_levers() -> None:
    hand = load_hand("barrett")
    joints = torch.tensor([[0.5, 1.0, 1.0, 1.0]]).double()
    tips = hand.fingertips(joints)
    contacts = tips[:, :, :3, 3]
    # Against the way each fingertip takes when its finger closes.
    moved = joints.clone()
    moved[:, hand.joint_index(tuple(next(iter(f.closing)) for f in hand.fingers))] += 1e-5
    way = (hand.fingertips(moved)[:, :, :3, 3] - contacts) / 1e-5
    size = torch.linalg.vector_norm(way, dim=2, keepdim=True)
    forces = normal_forces(hand, torch.eye(4)[None], joints, contacts, -way / size)
    efforts = torch.stack([hand.efforts[hand.joint_names.index(next(iter(f.closing)))] for f in hand.fingers])
    torch.testing.assert_close(forces[0], efforts / size[0, :, 0], rtol=1e-3, atol=0)


def test_bad_load_is_one_clear_error() -> None:
    with pytest.raises(DexgraspError, match="masses in order"):
        Load(lightest=2.0)
