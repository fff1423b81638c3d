"""Checkpoints: safetensors whose header holds, as JSON, all that is needed to build the model again.

No pickle and no import path: a file from a stranger can only name installed plugins. The header is also written beside
the weights as a readable ``.json``, which is never read back.
"""

import difflib
import json
import logging
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dexgrasp.errors import DexgraspError, room
from dexgrasp.hand import Hand

log = logging.getLogger(__name__)
FORMAT = 1
WEIGHTS = Path(__file__).parent / "weights"
"""Shipped checkpoints, ``<name>.safetensors``."""
FILE = "model.safetensors"
"""Name of the checkpoint in a training's folder."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], notes: Mapping[str, Any]) -> None:
    """Write tensors and JSON notes as one file, which appears whole or not at all."""
    header = {"format": FORMAT, **notes}
    rows = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
    replace_file(path, save(rows, metadata={"dexgrasp": json.dumps(header)}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors (on the CPU) and notes of `write_tensors`; `DexgraspError` where the file cannot serve."""
    if not path.is_file():
        raise DexgraspError("a checkpoint file", f"no file {path}", "check the path")
    try:
        with safe_open(path, framework="pt") as file:
            notes = json.loads((file.metadata() or {}).get("dexgrasp", "null"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  not a mapping
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise DexgraspError(
            f"a whole safetensors file {path}",
            f"{path.stat().st_size} bytes that are none ({error})",
            "copy the file again, or train again: it is truncated or not a checkpoint",
        ) from error
    if not isinstance(notes, dict) or notes.get("format") != FORMAT:
        raise DexgraspError(
            f"a checkpoint of dexgrasp, format {FORMAT}, in {path}",
            "no header of dexgrasp" if not isinstance(notes, dict) else f"format {notes.get('format')}",
            "use a file that `python -m dexgrasp train` of this version wrote",
        )
    return tensors, notes


def replace_file(path: Path, content: bytes) -> None:
    """Write a file by way of a temporary one, so that a crash leaves the old content or the new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with room(f"{len(content)} bytes", path.parent):
        _replace(path, content)


def _replace(path: Path, content: bytes) -> None:
    handle, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def find_checkpoint(name_or_path: str | Path) -> Path:
    """Return the file meant by a path, a training's folder or the name of shipped weights."""
    path = Path(name_or_path).expanduser()
    shipped = {file.stem: file for file in sorted(WEIGHTS.glob("*.safetensors"))}
    if str(name_or_path) in shipped and not (path.is_file() or (path / FILE).is_file()):
        return shipped[str(name_or_path)]  # a folder that happens to be called so is not meant
    if path.is_dir():
        if not (path / FILE).is_file():
            raise DexgraspError(
                f"{FILE} in the folder {path}", "no such file", "give the folder of a finished training"
            )
        return path / FILE
    if path.is_file():
        return path
    close = difflib.get_close_matches(str(name_or_path), shipped, n=1)
    raise DexgraspError(
        f"a checkpoint's path, or shipped weights: {', '.join(shipped) or 'none are shipped'}",
        repr(str(name_or_path)),
        f"did you mean {close[0]!r}?" if close else "check the path; `python -m dexgrasp train` makes a checkpoint",
    )


def load_state(module: torch.nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Load weights that must fit exactly."""
    own = module.state_dict()
    strange = sorted(set(own) ^ set(tensors))
    strange += sorted(key for key in set(own) & set(tensors) if own[key].shape != tensors[key].shape)
    if strange:
        raise DexgraspError(
            f"weights in {path} for the network that its header describes",
            f"{len(strange)} of {len(own)} tensors are missing, unknown or of another shape, first {strange[0]!r}",
            "use the version of dexgrasp and of the plugins that wrote it",
        )
    module.load_state_dict(dict(tensors))


def load_start(module: torch.nn.Module, hand: Hand, config: Mapping[str, Any], path: Path) -> None:
    """Load the weights that a new training of `module`, built from `config`, starts from.

    Raises DexgraspError where they are of another hand, representation or backbone, or of other sizes.
    """
    tensors, notes = read_tensors(path)
    if notes.get("kind") != "model":
        raise DexgraspError(
            "the weights of a finished training", f"{path}, which holds something else", f"give its {FILE}"
        )
    check_hand(hand, notes["hand"], path)
    # A scorer judges the grasps of one network; the new one gets its own.
    tensors = {key: value for key, value in tensors.items() if not key.startswith("scorer.")}
    trained, now = notes["config"], {key: plain(config[key]) for key in ("repr", "backbone")}
    other = [f"{kind}={trained[kind]['name']}" for kind in now if trained[kind]["name"] != now[kind]["name"]]
    differing = other or [
        f"{kind}.{key}={_word(trained[kind][key])}" if key in trained[kind] else f"no {kind}.{key}"
        for kind, settings in now.items()
        for key in {**trained[kind], **settings}
        if trained[kind].get(key) != settings.get(key)
    ]
    shapes, given = ({key: value.shape for key, value in each.items()} for each in (module.state_dict(), tensors))
    if other or shapes != given:
        raise DexgraspError(
            f"weights for repr={now['repr']['name']} backbone={now['backbone']['name']} as they are set",
            f"{path} of a network with {' '.join(differing) or 'other layers'}",
            "set the same here, start from other weights, or train without init_from",
        )
    if differing:
        log.warning("%s was trained with %s; going on from it with what is set here", path, " ".join(differing))
    module.load_state_dict(tensors)


def plain(config: Any) -> Any:
    """Return a config as JSON, with interpolations such as ${package:...} left as they are: no path of this machine."""
    return OmegaConf.to_container(config, resolve=False) if OmegaConf.is_config(config) else config


def _word(value: Any) -> str:
    """Return a value as it is typed on the command line."""
    return json.dumps(value, separators=(",", ":")).replace('"', "")


def kinematics(hand: Hand) -> dict[str, Any]:
    """Return what makes two hands the same for a network, as JSON: joints, limits, fingertips at three postures."""
    lower, upper = hand.limits.double().unbind(-1)
    postures = torch.stack([lower, lower + (upper - lower) * 0.4, lower + (upper - lower) * 0.7])
    return {
        "name": hand.name,
        "joints": list(hand.joint_names),
        "fingers": [finger.name for finger in hand.fingers],
        "limits": hand.limits.double().tolist(),
        "fingertips": hand.fingertips(postures)[..., :3, 3].double().tolist(),
    }


def check_hand(hand: Hand, trained: Mapping[str, Any], path: Path) -> None:
    """Raise where weights were trained for a hand other than `hand` (names, or 0.1 mm, 1e-4 rad)."""
    found = kinematics(hand)
    differing = [
        key
        for key in ("joints", "fingers", "limits", "fingertips")
        if not (_close(found[key], trained[key]) if key in ("limits", "fingertips") else found[key] == trained[key])
    ]
    if differing:
        raise DexgraspError(
            f"a checkpoint of the hand {hand.name!r} (joints {', '.join(hand.joint_names)})",
            f"{path} was trained for {trained['name']!r} (joints {', '.join(trained['joints'])}); "
            f"{', '.join(differing)} differ",
            "use that hand, or train for this one",
        )


def _close(a: Any, b: Any) -> bool:
    first, second = torch.tensor(a, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    return first.shape == second.shape and torch.allclose(first, second, rtol=0, atol=1e-4)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
