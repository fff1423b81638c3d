"""Shared test set-up."""

import os
import signal
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
import torch
from jaxtyping import install_import_hook

from dexgrasp.testing import shapes

# Shapes in signatures are true: checked in the modules of data and geometry, not in compiled ones (numba pickles them).
CHECKED = "batch backbone contact_frame evaluation execution fidelity geometry grasps hand kinematics representation"
CHECKED += " scene selection staged_contact urdf"
install_import_hook(
    [f"dexgrasp.{module}" for module in CHECKED.split()]
    + ["dexgrasp_contact", "dexgrasp_contact_roll", "dexgrasp_contact_width", "dexgrasp_grasp_type", "dexgrasp_pose"]
    + ["dexgrasp_pointnet"],
    f"{shapes.__name__}.check",
)

from dexgrasp import geometry  # noqa: E402
from dexgrasp.collision import HandShape  # noqa: E402
from dexgrasp.hand import Finger, Hand  # noqa: E402
from dexgrasp.plugins import load_hand  # noqa: E402

torch.set_num_threads(1)
if not torch.cuda.is_available():  # before Triton is imported: its kernels then run on the CPU, step by step
    os.environ.setdefault("TRITON_INTERPRET", "1")

# A shell that starts the tests in the background has them ignore Ctrl-C, which what they start inherits: the tests of
# interrupted runs would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first in each half: two workers begin with them and share small ones at the end."""
    slow = list(dict.fromkeys(item.path for item in items if item.get_closest_marker("slow")))
    early, late = ([item for item in items if item.path in files] for files in (slow[::2], slow[1::2]))
    other = [item for item in items if item.path not in slow]
    half = max(0, len(items) // 2 - len(early))
    items[:] = [*early, *other[:half], *late, *other[half:]]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of golden values and real meshes beside the checkout."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip(f"needs test data that is not here: {folder}")
    return folder


@pytest.fixture(scope="session")
def hand() -> Hand:
    """The BarrettHand. Look, do not touch: `load_hand` gives one to change."""
    return load_hand("barrett")


@pytest.fixture(scope="session")
def shape(hand: Hand) -> HandShape:
    """What collides of `hand`."""
    return HandShape(hand)


@pytest.fixture(scope="session")
def toy_hand():
    """A hand with unequal fingers: a spread that fingers 1 and 2 share, a third finger of two joints, a fixed joint."""
    return ToyHand()


TINY = [
    "dataset=smoke",
    "dataset.objects.count=2",
    "dataset.synthesis.target=100",
    "dataset.synthesis.rounds=2",
    "dataset.scenes.count=4",
    "dataset.scenes.counts=[2]",
    "dataset.views.framing.points=2048",
]
"""A dataset with one item a shard, so that several workers have work."""


@pytest.fixture(scope="session")
def tiny_overrides() -> list[str]:
    """`TINY`."""
    return TINY


@pytest.fixture(scope="session")
def composed():
    """Composes the config of `dataset` with `TINY`, a root and further overrides."""
    from hydra import compose, initialize_config_dir

    from dexgrasp import config

    def made(root: Path, *overrides: str):
        config.register()
        with initialize_config_dir(str(config.conf_folder()), version_base="1.3"):
            return compose("dataset", overrides=[*TINY, f"dataset.root={root}", *overrides])

    return made


@pytest.fixture(scope="session")
def common(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of this run of pytest, one for all its workers: xdist gives each a base folder of its own."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "common"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def tiny(common: Path, composed):
    """Config and dataset of `TINY`, each shard made by one process. Look, do not touch."""
    from dexgrasp.dataset.pipeline import ensure

    config = composed(common / "tiny", "dataset.workers=1")
    return config, ensure(config.dataset, config.hand, config.repr)


class ToyHand(Hand):
    """Fingers stand at radius 5 cm about z and bend towards it; analytic kinematics."""

    def __init__(self) -> None:
        self.name = "toy"
        self.joint_names = ("spread", "finger_1", "finger_2", "finger_3", "knuckle_3", "fixed")
        self.limits = torch.tensor(
            [[0, torch.pi], [0, 2.4], [0, 2.4], [-0.3, 1.2], [0, 1.5], [0.1, 0.1]], dtype=torch.float64
        )
        self.efforts = torch.ones(6)
        self.link_names = ("base", "tip_1", "tip_2", "tip_3")
        self.base_T_palm = torch.eye(4, dtype=torch.float64)
        self.visuals, self.collisions = {}, {}
        self.chains = (("spread", "finger_1"), ("spread", "finger_2"), ("finger_3", "knuckle_3"))
        names = self.joint_names
        mains = [tuple(n for n in names if n in (*chain, "spread")) for chain in self.chains]
        self.fingers = tuple(
            Finger(
                name=f"finger_{i + 1}",
                link=f"tip_{i + 1}",
                tip_radius=0.008 + 0.001 * i,
                tip_center=torch.tensor([0.045, 0.0, 0.004], dtype=torch.float64),
                outer_joint=torch.zeros(3, dtype=torch.float64),
                closing_axis=torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64),
                chain=chain,
                main=mains[i],
                supporting=tuple(n for n in names if n not in mains[i]),
                closing={chain[-1]: 1.0},
            )
            for i, chain in enumerate(self.chains)
        )

    def link_poses(self, joints):
        value = dict(zip(self.joint_names, joints.unbind(-1), strict=True))
        zero = torch.zeros_like(joints[:, 0])
        eye = torch.eye(3).to(joints).expand(len(joints), 3, 3)
        poses = {"base": geometry.pose(eye, torch.stack([zero, zero, zero], -1))}
        yaws = (value["spread"] - torch.pi / 2, -value["spread"] - torch.pi / 2, zero + torch.pi / 2)
        for i, yaw in enumerate(yaws):
            turn = geometry.axis_angle(joints.new_tensor([0.0, 0.0, 1.0]).expand(len(joints), 3), yaw)
            bend = value[self.chains[i][-1]] + (value["finger_3"] if i == 2 else 0)
            # At zero the link's x points up; bending turns it towards the hand's axis.
            flex = geometry.axis_angle(joints.new_tensor([0.0, -1.0, 0.0]).expand(len(joints), 3), torch.pi / 2 + bend)
            offset = (turn @ joints.new_tensor([0.05, 0.0, 0.0])).reshape(-1, 3) + joints.new_tensor([0, 0, 0.07])
            poses[f"tip_{i + 1}"] = geometry.pose(turn @ flex, offset)
        return poses
