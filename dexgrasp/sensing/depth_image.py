"""Depth images: 16-bit PNG, or arrays."""

import io
import re

import numpy as np
from numpy.typing import NDArray

from dexgrasp.sensing.limits import counted

Array = NDArray[np.float64]
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6}
KEY = re.compile(r"depth(?:_(?:(\d+(?:p\d+)?))?(m|cm|mm|um))?")
"""Array names: depth, or with a unit: depth_mm, depth_0p1mm (a tenth of a millimetre)."""


def parse_png(content: bytes) -> NDArray[np.generic]:
    """Return the grey values (H, W) of a 16-bit PNG; raises ValueError or OSError for others."""
    from PIL import Image

    with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
        counted(image.size[0] * image.size[1], "a PNG")
        if image.mode not in ("I;16", "I;16B", "I"):
            raise ValueError(f"a PNG of mode {image.mode}: depth is one 16-bit channel")
        return np.asarray(image).astype(np.uint16 if image.mode != "I" else np.int64)


def metres(image: NDArray[np.generic], scale: float | None) -> Array:
    """Return depth in metres, (H, W) float64; whole numbers are millimetres unless `scale` (m per unit) is told."""
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim != 2 or image.dtype.kind not in "uif":
        raise ValueError(f"a depth image of shape {image.shape} and type {image.dtype}, not (H, W) of numbers")
    if scale is None:
        scale = 1.0 if image.dtype.kind == "f" else 0.001
    return image.astype(np.float64) * scale


def unit_of(name: str) -> float | None:
    """Return the metres per unit that the name of an array tells, None where it tells none."""
    found = KEY.fullmatch(name)
    if found is None or found[2] is None:
        return None
    return float((found[1] or "1").replace("p", ".")) * UNITS[found[2]]
