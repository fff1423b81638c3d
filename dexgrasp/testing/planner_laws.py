"""Laws of a planner."""

from dataclasses import replace
from functools import cache

import torch
import trimesh

from dexgrasp.dataset.camera import Camera, MeshScene, Viewpoints
from dexgrasp.dataset.framing import Framing
from dexgrasp.dataset.noise import Noise
from dexgrasp.dataset.sensor import Sensor, capture
from dexgrasp.grasps import Grasps
from dexgrasp.objects import Object
from dexgrasp.planner import Planner, Situation
from dexgrasp.seeds import stream
from dexgrasp.testing.law import expect, expect_close

MOST = 5
GRANTS = ("points", "points and masks", "meshes and poses")


@cache
def two_boxes() -> Situation:
    """Return a noiseless look at two boxes on a table."""
    items, poses = [], torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    for row, (sides, place) in enumerate((((0.06, 0.05, 0.1), (-0.08, 0.0)), ((0.05, 0.07, 0.06), (0.08, 0.03)))):
        box = trimesh.creation.box(sides)
        items.append(Object(f"box_{row}", "box", box, (box,)))
        poses[row, :3, 3] = torch.tensor([*place, sides[2] / 2])
    camera = Sensor(Camera(640, 480, 615.0, 615.0, 319.5, 239.5), Noise())
    places, draw = [Viewpoints().draw(stream(0, "law", "viewpoint"))], stream(0, "law", "view")
    view = capture(MeshScene([item.mesh for item in items], poses), places, camera, Framing(), draw)
    return Situation(view, tuple(items), poses, None, 0)


def told(planner: Planner, situation: Situation) -> Grasps:
    """Return its grasps."""
    return planner.plan(situation, MOST)


def grants_are_named(planner: Planner) -> None:
    """`grants` says what of a situation is used, in one of the known words."""
    expect(planner.grants in GRANTS, f"`grants` to be one of {GRANTS}", planner.grants, "a phrase of its own")


def answers_are_whole(planner: Planner) -> None:
    """At most `top_k` grasps, best first: rigid poses before the camera, joints within the hand's limits."""
    grasps = told(planner, two_boxes())
    expect(0 < len(grasps) <= MOST, f"1 to {MOST} grasps of two boxes", len(grasps), "`top_k` not heeded, or no answer")
    expect((grasps.quality.diff() <= 0).all(), "quality falling", grasps.quality.tolist(), "grasps not sorted")
    turn = grasps.pose[:, :3, :3].double()
    unit = torch.eye(3, dtype=torch.float64).expand_as(turn)
    expect_close(turn @ turn.mT, unit, 1e-4, "rotations", "columns that are not normalised")
    ahead = (grasps.pose[:, 2, 3] > 0).all()
    expect(ahead, "hands before the camera (z forward)", grasps.pose[:, :3, 3].tolist(), "poses in the world frame")
    limits = planner.hand.limits.to(grasps.joints)
    low, high = grasps.joints - limits[:, 0], limits[:, 1] - grasps.joints
    expect(bool((low > -1e-4).all() & (high > -1e-4).all()), "joints within limits", grasps.joints, "no clamping")


def the_same_seed_gives_the_same_answer(planner: Planner) -> None:
    """What is random comes from `situation.seed` alone."""
    first, second = told(planner, two_boxes()), told(planner, two_boxes())
    expect(len(first) == len(second), f"{len(first)} grasps again", len(second), "a generator that goes on")
    expect_close(second.pose, first.pose, 0.0, "the same poses", "a generator that goes on")


def nothing_is_used_that_is_not_granted(planner: Planner) -> None:
    """Meshes, poses and masks that it says it does not use make no difference."""
    seen = two_boxes()
    if planner.grants == "meshes and poses":
        return
    view = seen.view
    if planner.grants == "points":
        view = replace(view, instance=torch.full_like(view.instance, -1))
    blind = Situation(view, (), torch.zeros(0, 4, 4, dtype=torch.float64), None, seen.seed)
    first, second = told(planner, seen), told(planner, blind)
    expect(len(first) == len(second), f"{len(first)} grasps", len(second), "it looks at what it was not granted")
    expect_close(second.pose, first.pose, 0.0, "the same poses", "it looks at what it was not granted")


LAWS = (grants_are_named, answers_are_whole, the_same_seed_gives_the_same_answer, nothing_is_used_that_is_not_granted)
