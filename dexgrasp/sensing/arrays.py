"""Arrays of numbers in NumPy's files; nothing in them is run, and nothing is unpacked beyond the limits."""

import io
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexgrasp.sensing.limits import FILE, counted


def load_npy(content: bytes) -> NDArray[Any]:
    """Return the array of a .npy file's content, numbers only; raises ValueError."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(file)
    if dtype.kind not in "biuf":
        raise ValueError(f"an array of {dtype}, not of numbers")
    size = 1
    for side in shape:
        size *= int(side)
    counted(size // 3, "the array")
    if size * dtype.itemsize > len(content):
        raise ValueError(f"{len(content)} bytes for an array of shape {shape} and type {dtype}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def load_npz(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a .npz file's content; raises ValueError where they unpack to more than the limit."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [each for each in archive.infolist() if each.filename.endswith(".npy")]
        if sum(each.file_size for each in members) > FILE:
            raise ValueError(f"arrays of more than {FILE >> 20} MiB")
        found = {}
        for each in members:
            with archive.open(each) as member:  # what the directory says of the size is not trusted
                plain = member.read(min(each.file_size, FILE) + 1)
            array = _one(plain)
            if array is not None:
                found[each.filename.removesuffix(".npy")] = array
    return found


def _one(content: bytes) -> NDArray[Any] | None:
    """Return an array, None for one that holds no numbers: it is not asked for."""
    try:
        return load_npy(content)
    except ValueError as error:
        if "not of numbers" in str(error):
            return None
        raise
