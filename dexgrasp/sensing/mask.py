"""Which pixels or points are the target object."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.arrays import load_npy, load_npz
from dexgrasp.sensing.limits import counted, sized

KINDS = (".png", ".npy", ".npz")


def read_mask(path: str | Path, value: int | None = None) -> NDArray[np.bool_]:
    """Return where an image or array has that value, or, for None, is not 0; raises DexgraspError for no such file."""
    path = Path(path).expanduser()
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise DexgraspError(f"a mask: {', '.join(KINDS)}", str(path), "convert it")
    content = sized(path).read_bytes()
    try:
        image = parse_mask(content, kind)
    except DexgraspError:
        raise
    except Exception as error:  # whatever is wrong in such a file
        raise DexgraspError(f"a mask in {path}", f"{type(error).__name__}: {error}", "write it again") from error
    if value is not None and not (image == value).any():
        values = ", ".join(f"{each:g}" for each in np.unique(image)[:20].tolist())
        raise DexgraspError(f"mask_value={value} somewhere in {path}", f"values {values}", "give one of these")
    return image != 0 if value is None else image == value


def parse_mask(content: bytes, kind: str) -> NDArray[Any]:
    """Return the numbers (H, W) or (P,) of a mask's file; raises ValueError, OSError or the like for others."""
    if kind == ".png":
        from PIL import Image

        with Image.open(io.BytesIO(content), formats=["PNG"]) as picture:
            counted(picture.size[0] * picture.size[1], "a PNG")
            image = np.asarray(picture)
        return image.max(axis=2) if image.ndim == 3 else image
    if kind == ".npy":
        return load_npy(content)
    arrays = load_npz(content)
    name = next((name for name in ("mask", "label", "labels", "segmap") if name in arrays), None)
    if name is None and len(arrays) != 1:
        raise ValueError(f"arrays {sorted(arrays)}, none of them mask or label")
    return arrays[name] if name is not None else next(iter(arrays.values()))
