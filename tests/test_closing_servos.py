"""Servos of closing joints: a finger of several joints waits for the one that bears most."""

import numpy as np
import pytest

from dexgrasp import load_hand
from dexgrasp.execution import closing_direction
from dexgrasp.simulation.closing_servos import ClosingServos
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.simulation.world import World

LEAD = 0.0125


@pytest.fixture(scope="module")
def world() -> World:
    world = World([], load_hand("allegro_right"), load_protocol("lift-v1").physics)
    pose = np.eye(4)
    pose[2, 3] = 0.5
    world.reset(np.zeros((0, 4, 4)))
    world.place_hand(pose, world.hand.limits.mean(dim=1).numpy())
    return world


def servos(world: World, together: bool, behind: dict[int, float]) -> ClosingServos:
    """Goals where the joints are, less those `behind`."""
    made = ClosingServos(world, closing_direction(world.hand).numpy(), together)
    made.begin(np.zeros(len(made.closing)))
    goals = np.array(made.joints)
    for row, way in behind.items():
        goals[row] += way
    made.begin(goals)
    return made


def test_joints_of_a_finger_wait_for_the_one_that_bears_most(world: World) -> None:
    for together in (True, False):
        made = servos(world, together, {1: LEAD})
        before = np.array(made.goals)
        made.follow((before + 0.01).tolist(), LEAD)
        moved = np.array(made.goals) - before
        free = np.full(len(moved), 0.01)
        free[[0, 1, 2] if together else [1]] = 0.0  # the finger whose second joint bears all it may
        assert moved == pytest.approx(free, abs=1e-12)
        assert world.data.ctrl[made.closing] * made.direction == pytest.approx(np.array(made.goals))


def test_goals_never_go_back_nor_beyond_the_end(world: World) -> None:
    made = servos(world, True, {1: 0.3})
    before = np.array(made.goals)
    made.follow([10.0] * len(before), LEAD)
    assert (np.array(made.goals) >= before).all() and (np.array(made.goals) <= made.end).all()
    assert np.array(made.goals)[:3] == pytest.approx(before[:3])


def test_squeezing_ends_where_a_joint_of_the_hand_bears_most(world: World) -> None:
    made = servos(world, True, {})
    before = np.array(made.goals)
    made.squeeze(before.tolist(), 0.02, 0.045, 0.005)
    assert np.array(made.goals) - before == pytest.approx(0.005)
    opposed = servos(world, True, {len(before) - 1: 0.05})
    before = np.array(opposed.goals)
    opposed.squeeze(before.tolist(), 0.02, 0.045, 0.005)
    assert np.array(opposed.goals) == pytest.approx(before)


def test_a_finger_has_stalled_once_its_most_loaded_joint_has(world: World) -> None:
    count = len(closing_direction(world.hand).nonzero())
    behind = {0: 0.02, 3: 0.02, 6: 0.02, 9: 0.02}
    assert servos(world, True, behind).stalled(0.01, 0.02)
    assert not servos(world, False, behind).stalled(0.01, 0.02)
    assert servos(world, False, dict.fromkeys(range(count), 0.02)).stalled(0.01, 0.02)
