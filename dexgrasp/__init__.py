"""dexgrasp: hand-agnostic, multi-finger grasping.

The public names below load on first use, so that ``import dexgrasp`` costs nothing.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexgrasp import kernel_cache

if TYPE_CHECKING:
    from dexgrasp import quality
    from dexgrasp.arm import load_arm
    from dexgrasp.dataset.dataset import open_dataset
    from dexgrasp.model import load_model
    from dexgrasp.motion import trajectory
    from dexgrasp.plugins import load_backbone, load_hand, load_representation
    from dexgrasp.reachability import reachable

__version__ = "0.1.0"
__all__ = [
    "load_arm",
    "load_backbone",
    "load_hand",
    "load_model",
    "load_representation",
    "open_dataset",
    "quality",
    "reachable",
    "trajectory",
]

kernel_cache.separate(Path(__file__).parent)

_HOMES = {
    "load_hand": "dexgrasp.plugins",
    "load_representation": "dexgrasp.plugins",
    "load_backbone": "dexgrasp.plugins",
    "load_model": "dexgrasp.model",
    "open_dataset": "dexgrasp.dataset.dataset",
    "trajectory": "dexgrasp.motion",
    "load_arm": "dexgrasp.arm",
    "reachable": "dexgrasp.reachability",
}


def __getattr__(name: str) -> Any:
    if name == "quality":
        return import_module("dexgrasp.quality")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'dexgrasp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
