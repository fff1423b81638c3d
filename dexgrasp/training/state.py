"""The state of a training on disk: enough to go on exactly where it stopped."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dexgrasp.checkpoint import read_tensors, write_tensors
from dexgrasp.model import GraspNet

FILE = "training.safetensors"


def save(
    path: Path, model: GraspNet, average: dict[str, Tensor], optimizer: Any, step: int, losses: dict[str, float]
) -> None:
    tensors = {f"model.{key}": value for key, value in model.state_dict().items()}
    tensors |= {f"ema.{key}": value for key, value in average.items()}
    for name, parameter in model.named_parameters():
        for key, value in optimizer.state[parameter].items():
            tensors[f"optimizer.{name}.{key}"] = value
    write_tensors(path, {key: value.detach().cpu() for key, value in tensors.items()}, {"step": step, "losses": losses})


def resume(path: Path, model: GraspNet, average: dict[str, Tensor], optimizer: Any, device: torch.device) -> int:
    if not path.is_file():
        return 0
    tensors, notes = read_tensors(path)
    model.load_state_dict({k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")})
    for key, value in average.items():
        value.copy_(tensors[f"ema.{key}"])
    for name, parameter in model.named_parameters():
        prefix = f"optimizer.{name}."
        state = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
        optimizer.state[parameter] = {k: v if k == "step" else v.to(device) for k, v in state.items()}
    return int(notes["step"])
