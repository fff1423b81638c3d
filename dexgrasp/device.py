"""The device that a config names, and what may run there."""

import torch

from dexgrasp.errors import DexgraspError


def takes_compiled(values: torch.Tensor) -> bool:
    """Return whether compiled code may stand in for plain torch: single precision on a CPU, and nothing traces."""
    return values.device.type == "cpu" and values.dtype == torch.float32 and not torch.compiler.is_compiling()


def find_device(name: str | torch.device, key: str) -> torch.device:
    """Return the device `name`: cpu, cuda, cuda:1, or auto, which is CUDA where there is one.

    Raises DexgraspError where there is none of that name; `key` is where it was told.
    """
    there, name = torch.cuda.is_available(), str(name)
    if name == "auto":
        return torch.device("cuda" if there else "cpu")
    kind, _, number = name.partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdecimal()):
        raise DexgraspError(f"{key} auto, cpu, cuda or cuda:1", repr(name), "choose one of them")
    if kind == "cuda" and not there:
        raise DexgraspError(f"a CUDA device for {key}={name}", "torch sees none", f"use {key}=cpu")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        many = torch.cuda.device_count()
        raise DexgraspError(f"a CUDA device for {key}={name}", f"there are {many}, counted from 0", "choose another")
    return torch.device(name)
