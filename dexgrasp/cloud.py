"""From a user's points to a network's cloud: checked, with normals, thinned."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.seeds import stream

FEWEST = 32
FARTHEST = 20.0
"""Median distance from the camera (m) beyond which a cloud is taken to be in millimetres."""
DENSE = 4
"""Normals of very dense clouds are estimated from this many times the network's points, ..."""
NEIGHBOURS = 120
"""... and this many of each point's neighbours."""

Array = Float[np.ndarray, "P 3"] | Float[Tensor, "P 3"]


def prepare(points: Array, normals: Array | None, count: int, seed: int, outward: bool = False) -> Float[Tensor, "N 6"]:
    """Return positions (m) and unit normals towards the camera of at most `count` points, float32, on the CPU.

    Points are in the camera frame. Larger clouds are thinned at random, the dominant plane more than the rest; the
    same for the same seed. Normals that are `outward` already, of views from several sides, are not turned. Raises
    `DexgraspError` for anything that is not a cloud in metres.
    """
    xyz = _checked("points", points)
    if len(xyz) < FEWEST:
        raise DexgraspError(f"at least {FEWEST} points", f"{len(xyz)}", "give the cloud of a whole view")
    distance = float(torch.linalg.vector_norm(xyz, dim=1).median())
    if distance > FARTHEST:
        raise DexgraspError(
            "points in metres in the camera frame",
            f"a median distance of {distance:.4g} from the camera, which looks like millimetres",
            "divide the points by 1000 (`predict`: scale=0.001)",
        )
    directions = None if normals is None else _unit(xyz, _checked("normals", normals), outward)
    if directions is None and len(xyz) > DENSE * count:
        xyz = xyz[_thin(xyz, DENSE * count, seed)]
    chosen = _thin(xyz, count, seed)
    if directions is None:
        from dexgrasp.dataset.normals import estimate_normals

        directions = estimate_normals(xyz, k=NEIGHBOURS, at=chosen.numpy())
    else:
        directions = directions[chosen]
    return torch.cat([xyz[chosen], directions], dim=1).float()


def _thin(xyz: Float[Tensor, "P 3"], count: int, seed: int) -> Int[Tensor, "N"]:
    """Choose points as the training data's clouds are chosen: a large table does not crowd out what stands on it."""
    if len(xyz) <= count:
        return torch.arange(len(xyz))
    from dexgrasp.dataset.framing import Framing, downsample

    return torch.from_numpy(downsample(xyz.numpy(), Framing(points=count), stream(seed, "thin", count)))


def _unit(xyz: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"], outward: bool) -> Float[Tensor, "P 3"]:
    """Return unit normals, on the camera's side unless they are `outward` already."""
    if normals.shape != xyz.shape:
        raise DexgraspError(f"one normal per point, {tuple(xyz.shape)}", f"{tuple(normals.shape)}", "match them")
    length = torch.linalg.vector_norm(normals, dim=1, keepdim=True)
    if (length == 0).any():
        raise DexgraspError("normals of non-zero length", f"{int((length == 0).sum())} zeros", "leave normals out")
    unit = normals / length
    return unit if outward else torch.where((unit * xyz).sum(1, keepdim=True) > 0, -unit, unit)


def _checked(name: str, values: Array) -> Float[Tensor, "P 3"]:
    rows = torch.as_tensor(values).detach().cpu()
    if rows.dim() != 2 or rows.shape[1] != 3 or rows.is_complex() or rows.dtype == torch.bool:
        raise DexgraspError(f"{name} as an array of shape (P, 3)", f"{rows.dtype} {tuple(rows.shape)}", "reshape it")
    rows = rows.double()
    broken = int((~rows.isfinite()).any(dim=1).sum())
    if broken:
        raise DexgraspError(
            f"finite {name}",
            f"{broken} of {len(rows)} rows with NaN or infinity",
            f"drop pixels without depth first: {name}[numpy.isfinite(points).all(axis=1)]",
        )
    return rows
