"""Physics: scenes at rest, grasps that hold and that do not, forces within the hand's limits."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
import trimesh

import dexgrasp
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.objects import Object
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.simulation.world import TABLE, World

PROTOCOL = load_protocol("lift-v1")


def convex(mesh: trimesh.Trimesh, name: str = "thing") -> Object:
    return Object(name, "test", mesh, (mesh,))


BOX = convex(trimesh.creation.box((0.06, 0.06, 0.06)))
CYLINDER = convex(trimesh.creation.cylinder(0.03, 0.1))
BALL = convex(trimesh.creation.icosphere(3, 0.03))
SIMPLE = {"box": (BOX, 0.03), "cylinder": (CYLINDER, 0.05), "ball": (BALL, 0.03)}


@pytest.fixture(scope="module")
def simulator() -> MujocoSimulator:
    return MujocoSimulator()


def at(*places: tuple[float, float, float]) -> torch.Tensor:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    poses[:, :3, 3] = torch.tensor(places, dtype=torch.float64)
    return poses


def from_above(*heights: float, joints: tuple[float, ...] = (0.0, 1.0, 1.0, 1.0)) -> Grasps:
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)).repeat(len(heights), 1, 1)
    pose[:, 2, 3] = torch.tensor(heights, dtype=torch.float64)
    return Grasps.build(pose, torch.tensor([joints] * len(heights), dtype=torch.float64), 3)


def changed(**groups: dict[str, float]):
    return dataclasses.replace(
        PROTOCOL, **{name: dataclasses.replace(getattr(PROTOCOL, name), **values) for name, values in groups.items()}
    )


@pytest.mark.parametrize("name", SIMPLE)
def test_lifts_simple_things_and_misses_air(name, hand, simulator) -> None:
    item, height = SIMPLE[name]
    outcomes = simulator.execute([item], at((0, 0, height)), hand, from_above(0.195, 0.45, 0.1), PROTOCOL)
    assert outcomes.reason.tolist() == [Reason.SUCCESS, Reason.MISSED, Reason.COLLIDED]
    assert outcomes.success.tolist() == [True, False, False]
    assert outcomes.object[:2].tolist() == [0, -1]
    assert float(outcomes.height[0]) == pytest.approx(0.30, abs=0.02)
    torch.testing.assert_close(outcomes.final[1, 0, :3, 3], at((0, 0, height))[0, :3, 3], atol=1e-3, rtol=0)


@dataclasses.dataclass
class Case:
    """One attempt from above; things are placed by their centres."""

    reason: Reason
    height: float = 0.195
    things: tuple[tuple[float, float, float], ...] = ((0.06, 0.06, 0.06),)
    places: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.03),)
    joints: tuple[float, ...] = (0.0, 1.0, 1.0, 1.0)
    groups: dict = dataclasses.field(default_factory=dict)

    def told(self, simulator, hand, **verdict: float) -> Reason:
        groups = {**self.groups, "verdict": verdict}
        things, grasps = (
            [convex(trimesh.creation.box(t)) for t in self.things],
            from_above(self.height, joints=self.joints),
        )
        outcomes = simulator.execute(things, at(*self.places), hand, grasps, changed(**groups))
        assert bool(outcomes.success) is (int(outcomes.reason) == Reason.SUCCESS)
        return Reason(int(outcomes.reason))


ONE_SIDE = (np.pi, 0.8, 0.8, 0.8)
"""Spread so that all fingers close from the same side: they hold nothing, they push."""
CASES = {
    "the fingers start inside it": Case(Reason.COLLIDED, 0.03),
    "the palm pushes it": Case(Reason.COLLIDED, 0.13, ((0.02, 0.02, 0.12),), ((0, 0, 0.06),)),
    "the table stops the hand": Case(Reason.COLLIDED, 0.05, places=((0.3, 0, 0.03),)),
    "nothing is there": Case(Reason.MISSED, 0.45),
    "it stands beside": Case(Reason.MISSED, places=((0.2, 0, 0.03),)),
    "the table stops the fingers": Case(Reason.MISSED, 0.18),
    "pushed over": Case(Reason.TOPPLED, 0.2, ((0.06, 0.06, 0.1),), ((0, -0.02, 0.05),), ONE_SIDE),
    "rolled over an edge, higher for a while": Case(
        Reason.TOPPLED, 0.19, ((0.06, 0.06, 0.07),), ((0, -0.02, 0.035),), ONE_SIDE, {"physics": {"friction": 2.0}}
    ),
    "pushed along": Case(Reason.TOPPLED, groups={"physics": {"friction": 0.02}}),
    "thrown when the lift stops dead": Case(Reason.SLIPPED, groups={"motion": {"lift_time": 0.03}}),
    "two abreast": Case(
        Reason.MULTIPLE, things=((0.03, 0.06, 0.06),) * 2, places=((-0.0151, 0, 0.03), (0.0151, 0, 0.03))
    ),
    "too heavy": Case(Reason.NOT_LIFTED, groups={"physics": {"mass_min": 30.0, "mass_max": 30.0}}),
}


@pytest.mark.parametrize("name", CASES)
def test_every_failure_has_its_reason(name, hand, simulator) -> None:
    assert CASES[name].told(simulator, hand) is CASES[name].reason


def test_limits_of_the_verdict_are_the_protocols(hand, simulator) -> None:
    """Each limit, moved past what happened, changes what is told of the same motion."""
    assert CASES["pushed along"].told(simulator, hand, pushed=1.0) in (Reason.NOT_LIFTED, Reason.MISSED)
    assert CASES["two abreast"].told(simulator, hand, alongside=0.35) is Reason.SUCCESS
    assert CASES["thrown when the lift stops dead"].told(simulator, hand, left=1.0) is Reason.TOPPLED
    assert CASES["the palm pushes it"].told(simulator, hand, displaced=1.0, blocked=1.0) is not Reason.COLLIDED


def test_another_target_is_no_success(hand, simulator) -> None:
    poses, grasps = at((0, 0, 0.03), (0.3, 0, 0.03)), from_above(0.195, 0.195)
    outcomes = simulator.execute([BOX, BALL], poses, hand, grasps, PROTOCOL, target=torch.tensor([0, 1]))
    assert outcomes.success.tolist() == [True, False]


def test_absent_objects_are_not_there(hand, simulator) -> None:
    poses = at((0.3, 0, 0.03), (0, 0, 0.03))
    poses[1] = float("nan")
    outcomes = simulator.execute([BALL, BOX], poses, hand, from_above(0.195), PROTOCOL)
    assert outcomes.reason.tolist() == [Reason.MISSED]
    assert outcomes.final[0, 1].isnan().all()
    assert simulator.settle([BALL, BOX], poses, 0)[1].isnan().all()


def test_attempts_do_not_know_of_each_other(hand) -> None:
    poses, grasps = at((0, 0, 0.03), (0.2, 0, 0.03)), from_above(0.195, 0.1, 0.2, 0.45)
    order = torch.tensor([3, 2, 1, 0])
    forward = MujocoSimulator().execute([BOX, BALL], poses, hand, grasps, PROTOCOL)
    backward = MujocoSimulator().execute([BOX, BALL], poses, hand, grasps[order], PROTOCOL)[order]
    for name, value in forward.tensors().items():
        assert torch.equal(value, backward.tensors()[name]), name


@pytest.mark.parametrize("name", SIMPLE)
def test_rest_stays_rest(name, simulator) -> None:
    item, height = SIMPLE[name]
    rest = simulator.settle([item], at((0, 0, height + 0.01)), 0)
    assert float(rest[0, 2, 3]) == pytest.approx(height, abs=1e-3)
    world = simulator.world([item], None, PROTOCOL.physics)
    world.reset(rest.numpy())
    for _ in range(1000):
        mujoco.mj_step(world.model, world.data)
    assert np.linalg.norm(world.poses()[0, :3, 3] - rest[0, :3, 3].numpy()) < 1e-3
    assert world.speeds()[0] < PROTOCOL.physics.rest_speed


def test_settle_reports_what_left_the_table(simulator) -> None:
    rest = simulator.settle([BOX, BALL], at((0, 0, 0.04), (0.7, 0, 0.04)), 0)
    assert rest[0].isfinite().all() and rest[1].isnan().all()


def test_skips_tilted_grasps(hand, simulator) -> None:
    grasps = from_above(0.195)
    turn = torch.eye(4, dtype=torch.float64)
    turn[1:3, 1:3] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    protocol = load_protocol("cmgnet-code")
    tilted = grasps.replace(pose=grasps.pose @ turn)
    assert simulator.execute([BOX], at((0, 0, 0.03)), hand, tilted, protocol).reason.tolist() == [Reason.NO_GRASP]
    assert simulator.execute([BOX], at((0, 0, 0.03)), hand, grasps, protocol).reason.tolist() != [Reason.NO_GRASP]


def test_compiled_world_has_the_protocols_numbers(hand) -> None:
    world = World([BOX], hand, PROTOCOL.physics)
    model, physics = world.model, PROTOCOL.physics
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and model.opt.impratio == physics.impratio
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST and model.opt.timestep == physics.timestep
    np.testing.assert_allclose(model.geom_friction[:, 0], physics.friction)
    np.testing.assert_allclose(model.body("object/0").mass, 500 * 0.06**3)
    np.testing.assert_allclose(model.joint("hand/finger_1").range, hand.limits[1].numpy())
    hands = [i for i in range(model.nbody) if model.body(i).name.startswith("hand/")]
    assert model.body_mass[hands].sum() == pytest.approx(sum(hand.masses.values()), rel=1e-6)
    assert (model.geom_condim[world._owner == TABLE] == 6).all()


def test_tip_force_and_coupling_at_the_torque_limit(hand) -> None:
    """A finger driven with all of its torque against a fixed block presses with about 15 N; coupling holds to 1 %."""
    physics = dataclasses.replace(PROTOCOL.physics, mass_min=1e4, mass_max=1e4, gravity=0.0)
    world = World([convex(trimesh.creation.box((0.2, 0.04, 0.4)))], hand, physics)
    # Finger 3 stands at +y and closes towards -y; spread 180 deg takes the other two out of its way.
    # Well above the table, so that the tip is all that touches.
    world.reset(at((0, -0.005, 0.80)).numpy())
    world.place_hand(at((0, 0, 0.5))[0].numpy(), np.array([np.pi, 0.0, 0.0, 0.9]))
    world.data.ctrl[3] = 2.4
    for _ in range(1500):
        mujoco.mj_step(world.model, world.data)
    assert abs(world.data.actuator_force[3]) == pytest.approx(float(hand.efforts[3]), rel=1e-6)
    force, total = np.zeros(6), 0.0
    for number, contact in enumerate(world.data.contact):
        mujoco.mj_contactForce(world.model, world.data, number, force)
        total += force[0]
        bodies = {world.model.body(world.model.geom_bodyid[geom]).name for geom in contact.geom}
        assert bodies == {"object/0", "hand/finger_3_outer"}
    assert total == pytest.approx(15, abs=3)
    names = ("finger_3", "finger_3_outer")
    inner, outer = (world.data.qpos[world.model.joint(f"hand/{name}").qposadr[0]] for name in names)
    assert outer / inner == pytest.approx(1 / 3, rel=0.01)
    assert world.intrusion() < 1e-3


def test_drift_carried_forward_ends_like_every_step() -> None:
    """A grip that creeps off, one that holds and one that cannot: leaps change neither verdict nor final height."""
    hand, simulator = dexgrasp.load_hand("barrett"), MujocoSimulator()
    grasps = from_above(0.195, 0.198, 0.201, 0.203, 0.205)
    for friction in (0.6, 0.25):
        protocols = [changed(physics={"friction": friction, "leap": leap}) for leap in (0.0, 0.1)]
        slow, fast = (simulator.execute([CYLINDER], at((0, 0, 0.05)), hand, grasps, p) for p in protocols)
        assert fast.reason.tolist() == slow.reason.tolist()
        held = slow.success
        torch.testing.assert_close(fast.height[held], slow.height[held], atol=2e-3, rtol=0)


def test_a_free_way_is_not_simulated_and_an_obstructed_one_is(hand) -> None:
    """Where nothing is touched the objects rest as they would have; where something is, it is pushed."""
    world = World([BOX, BALL], hand, PROTOCOL.physics)
    poses = at((0, 0, 0.03), (0.15, 0, 0.031)).numpy()
    moved = world.rest(poses, 100, 10)
    assert (moved > 0).all() and (moved < 2e-3).all()
    before = world.poses()
    world.rest(poses, 100, 10)
    assert (world.poses() == before).all(), "the same again"
    grasp = from_above(0.195)
    world.place_hand(grasp.pose[0].numpy(), grasp.joints[0].numpy() - [0, 0.35, 0.35, 0.35])
    above = np.linspace([0, 0, 0.3], [0, 0, 0.195], 20)
    assert world.passes(above)
    assert not world.passes(above - [0, 0, 0.1])
    fingers = np.linspace(0.0, 2.4, 60)
    joints = np.stack([np.zeros(60), fingers, fingers, fingers], axis=1)
    free = world.free_way(grasp.pose[0].numpy(), joints)
    assert 0 < free < 60 and 0.6 < fingers[free] < 1.3
    world.place_hand(grasp.pose[0].numpy(), joints[free - 1])
    assert not world.touched().any()
    world.place_hand(grasp.pose[0].numpy(), joints[free])
    assert world.touched().any()


def test_objects_asleep_wake_when_they_are_touched(hand) -> None:
    bulk = load_protocol("lift-bulk-v1")
    poses = at((0, 0, 0.03), (0.3, 0, 0.03), (-0.3, 0, 0.05))
    outcomes = MujocoSimulator(bulk).execute([BOX, BALL, CYLINDER], poses, hand, from_above(0.195, 0.45), bulk)
    assert outcomes.reason.tolist() == [Reason.SUCCESS, Reason.MISSED] and int(outcomes.object[0]) == 0
    torch.testing.assert_close(outcomes.final[0, 1:, :3, 3], poses[1:, :3, 3], atol=2e-3, rtol=0)


@pytest.mark.parametrize("name", [n for n, case in CASES.items() if not case.groups])
def test_bulk_tells_the_same_reasons(name, hand) -> None:
    case, bulk = CASES[name], load_protocol("lift-bulk-v1")
    things = [convex(trimesh.creation.box(t)) for t in case.things]
    outcomes = MujocoSimulator(bulk).execute(
        things, at(*case.places), hand, from_above(case.height, joints=case.joints), bulk
    )
    assert Reason(int(outcomes.reason[0])) is case.reason
