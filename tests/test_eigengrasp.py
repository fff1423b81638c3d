"""The EigenGrasp planner: force closure on simple bodies, repeatable, clear of the table."""

import numpy as np
import pytest
import torch
import trimesh
from dexgrasp_eigengrasp.annealing import neighbour, temperature
from dexgrasp_eigengrasp.energy import state_energy
from dexgrasp_eigengrasp.planner import SCHEDULE

from dexgrasp.collision import HandShape
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import look_at
from dexgrasp.objects import Object
from dexgrasp.planner import Situation
from dexgrasp.plugins import load_hand, load_planner
from dexgrasp.quality import epsilon, wrenches
from dexgrasp.scene import Boxes, View

QUICK = {"chains": 8, "steps": 2000}


def body(mesh, name):
    return Object(name, "test", mesh, (mesh.convex_hull,))


BOX = body(trimesh.creation.box((0.06, 0.05, 0.12)), "box")
CAN = body(trimesh.creation.cylinder(0.033, 0.11, sections=48), "can")


def situation(items, poses, seed=0, fixtures=None):
    world_T_camera = look_at(torch.tensor([0.4, 0.1, 0.6]).double(), torch.zeros(3).double())
    empty = View(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), world_T_camera)
    return Situation(empty, tuple(items), poses, fixtures, seed)


def standing(item, x):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, 0.0, -item.mesh.bounds[0, 2]])
    return pose


@pytest.mark.parametrize("name", ["barrett", "panda"])
@pytest.mark.parametrize("item", [BOX, CAN], ids=lambda item: item.name)
def test_grasps_close_by_force_and_do_not_reach_into_the_object(name, item):
    hand = load_hand(name)
    planner = load_planner("eigengrasp", hand, **QUICK)
    grasps = planner.grasp(item, None, 0)
    assert len(grasps)
    assert (grasps.quality[:-1] >= grasps.quality[1:]).all()
    torsion = 0.02 if name == "panda" else 0.0
    again = epsilon(wrenches(grasps.contacts, grasps.normals, item.com, item.radius, 0.5, 8, torsion))
    torch.testing.assert_close(again, grasps.quality)
    assert grasps.quality[0] > 0.02
    depth = HandShape(hand).object_distance(planner.field(item), grasps.pose, grasps.joints)
    assert depth.min() > -planner.penetration - 1e-6
    assert torch.equal(planner.grasp(item, None, 0).pose, grasps.pose)
    assert not torch.equal(planner.grasp(item, None, 1).pose[0], grasps.pose[0])


def test_a_scene_s_grasps_keep_off_the_table_and_know_their_object(hand):
    poses = torch.stack([standing(BOX, 0.0), standing(CAN, 0.3)])
    planner = load_planner("eigengrasp", hand, **QUICK)
    seen = situation([BOX, CAN], poses)
    grasps = planner.plan(seen, 20)
    assert 0 < len(grasps) <= 20
    assert (grasps.quality[:-1] >= grasps.quality[1:]).all()
    world = grasps.moved(seen.view.world_T_camera)
    assert HandShape(hand).table_distance(world.pose, world.joints).min() > 0.0019
    for number, item in enumerate((BOX, CAN)):
        own = world[world.object == number].moved(torch.linalg.inv(poses[number]))
        found = planner.field(item).distance(own.contacts.reshape(-1, 3))
        assert found.abs().max() < 1e-6 if len(own) else True
    # A block that fills the place leaves none.
    wall = Boxes(torch.eye(4, dtype=torch.float64)[None], torch.full((1, 3), 0.5, dtype=torch.float64))
    assert len(planner.plan(situation([BOX, CAN], poses, fixtures=wall), 20)) == 0
    assert len(planner.plan(situation([], torch.zeros(0, 4, 4, dtype=torch.float64)), 20)) == 0


def test_energy_falls_as_contacts_come_nearer_and_below_zero_where_forces_balance(hand):
    planner = load_planner("eigengrasp", load_hand("panda"))
    wanted = planner.wanted._replace(
        links=np.array([0, 1]),
        points=np.array([[0.0, 0, 0, 0, 1, 0], [0.0, 0, 0, 0, -1, 0]]),
        friction=0.5,
    )
    field = planner.field(BOX).field

    def energy(gap, guided):
        poses = np.tile(np.eye(4)[:3], (2, 1, 1))
        poses[0, 1, 3], poses[1, 1, 3] = -0.025 - gap, 0.025 + gap
        return state_energy(wanted._replace(guided=guided), field, poses, np.empty(7), np.empty((3, 4)), np.empty(1))

    gaps = [0.2, 0.1, 0.03, 0.02, 0.001]  # at 0.04 a contact weighs too little to count
    assert energy(0.1, False) == pytest.approx(100.0)  # mm, both face the object
    alone = [energy(gap, False) for gap in gaps]
    assert alone == sorted(alone, reverse=True)
    guided = [energy(gap, True) for gap in gaps]
    assert guided == sorted(guided, reverse=True)
    assert guided[1] > 0 > guided[2]


def test_schedule_cools_and_jumps_shrink_with_it():
    warm, cold = (temperature(SCHEDULE, step) for step in (SCHEDULE.first, SCHEDULE.last))
    assert warm > cold > 0
    units = np.linspace(0, 1, 101)
    for heat in (warm, cold):
        jumps = np.array([neighbour(heat, unit) for unit in units])
        np.testing.assert_allclose(jumps, -jumps[::-1], atol=1e-12)
        assert np.abs(jumps).max() == pytest.approx(1.0)
    assert abs(neighbour(cold, 0.75)) < abs(neighbour(warm, 0.75))


def test_eigengrasps_are_the_hand_s_synergies_or_its_closing(hand):
    spread_and_closing = load_planner("eigengrasp", hand).postures
    assert len(spread_and_closing.axes) == 2
    ends = spread_and_closing.postures(torch.tensor([[0.0, 0.0], [1.0, 1.0]]).double())
    torch.testing.assert_close(ends, hand.limits.T)
    assert len(load_planner("eigengrasp", load_hand("allegro_right")).postures.axes) == 4


@pytest.mark.parametrize(
    "options, word",
    [
        ({"steps": 0}, "steps"),
        ({"energy": "kinetic"}, "energy"),
        ({"contacts": ["thumb"]}, "contacts"),
        ({"synergy": "none such"}, "synergy"),
        ({"stepz": 3}, "steps"),
        ({"approach": {"retreet": 0.1}}, "retreat"),
    ],
)
def test_wrong_options_are_told(hand, options, word):
    with pytest.raises(DexgraspError, match=word):
        load_planner("eigengrasp", hand, **options)
