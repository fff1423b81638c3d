"""What foretells verdicts of physics from how fingers close on the true object."""

import pytest
import torch

import dexgrasp
from dexgrasp.dataset.truth import Outcome
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.grasps import Grasps
from dexgrasp.statistics import roc_area
from dexgrasp.training.surrogate import FACTS, Surrogate, facts

CLEAR, TOUCHED, DEPTH, HEIGHT, UP, SIDEWAYS, HIGHEST, LOWEST, SUM, PALM = 0, 1, 3, 8, 9, 10, 11, 12, 13, 16


def closed(contacts: torch.Tensor, normals: torch.Tensor) -> Outcome:
    """Return the outcome of grasps of something of 0.1 m radius and 2 N whose centre of mass is at (0.3, 0.1, 0.2)."""
    count = len(contacts)
    some, touched = torch.full((count,), 0.1), (~contacts.isnan().any(dim=2)).sum(dim=1)
    com = torch.tensor([0.3, 0.1, 0.2]).expand(count, 3)
    clear = torch.ones(count, dtype=torch.bool)
    return Outcome(clear, touched, touched, some, some, 10 * some, contacts, normals, com, some, 20 * some)


@pytest.mark.parametrize("name", ["barrett", "panda", "allegro_right"])
def test_facts_of_a_grasp(name):
    hand = dexgrasp.load_hand(name)
    fingers = len(hand.fingers)
    contacts = torch.full((2, fingers, 3), torch.nan)
    contacts[0, 0], contacts[0, 1] = torch.tensor([0.3, 0.15, 0.25]), torch.tensor([0.3, 0.09, 0.21])
    normals = contacts.clone()
    normals[0, 0], normals[0, 1] = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, -0.6, 0.8])
    grasps = Grasps.build(torch.eye(4).expand(2, 4, 4), torch.zeros(2, len(hand.joint_names)), fingers)
    found = facts(hand, grasps, closed(contacts, normals))
    assert found.shape == (2, FACTS) and found.isfinite().all(), "of a hand that touches nothing, too"
    wanted = {CLEAR: 1, TOUCHED: 2, DEPTH: 0.01, HEIGHT: 0.2, UP: 0.03, SIDEWAYS: 0.02, HIGHEST: 0.05, LOWEST: 0.01}
    wanted |= {SUM: (0.4**2 + 0.8**2) ** 0.5, PALM: float(hand.base_T_palm[2, 3])}
    for column, value in wanted.items():
        assert float(found[0, column]) == pytest.approx(value, abs=1e-6), column
    assert found[1, [TOUCHED, UP, SIDEWAYS, HIGHEST, LOWEST, SUM]].abs().max() == 0


def test_facts_are_the_same_from_all_sides_of_a_table():
    hand, generator = dexgrasp.load_hand("barrett"), torch.Generator().manual_seed(0)
    contacts, normals = torch.rand(2, 8, 3, 3, generator=generator).unbind(0)
    before = closed(contacts, normals)
    turn = axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.7))
    motion = pose(turn, torch.tensor([0.4, -0.2, 0.0]))
    grasps = Grasps.build(torch.eye(4).repeat(8, 1, 1), torch.zeros(8, 4), 3)
    grasps.pose[:, 2, 3] = torch.rand(8, generator=generator)
    after = before.replace(
        contacts=contacts @ turn.T + motion[:3, 3], normals=normals @ turn.T, com=before.com @ turn.T + motion[:3, 3]
    )
    found = facts(hand, grasps.moved(motion), after)
    torch.testing.assert_close(found, facts(hand, grasps, before), atol=1e-5, rtol=1e-5)


def test_it_learns_what_lifts_and_says_how_likely():
    generator = torch.Generator().manual_seed(0)
    known = torch.rand(3000, FACTS, generator=generator)
    likely = (8 * (known[:, 5] - known[:, 9].square()) - 2).sigmoid()
    lifted = torch.bernoulli(likely, generator=generator)
    surrogate = Surrogate.taught(known[:2000], lifted[:2000], seed=3)
    other = Surrogate.taught(known[:2000], lifted[:2000], seed=3)
    with torch.no_grad():
        told, again = surrogate(known[2000:]), other(known[2000:])
    assert torch.equal(told, again), "the same seed, the same result"
    assert (told - likely[2000:]).abs().mean() < 0.08
    best = roc_area(likely[2000:], lifted[2000:] > 0)
    assert roc_area(told, lifted[2000:] > 0) > best - 0.02
    assert told.std() > 0.2, "one that had learnt nothing would say the mean of all"
