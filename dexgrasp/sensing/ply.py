"""PLY: the vertices, ASCII or binary of either byte order."""

import numpy as np
from numpy.typing import NDArray

from dexgrasp.sensing.limits import counted

Array = NDArray[np.float64]
KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
HEADER = 65_536
"""Most bytes of a header."""


def parse_ply(content: bytes) -> Array:
    """Return x, y, z and, where there are some, normals of the vertices, (P, 3) or (P, 6); raises ValueError."""
    end = content.find(b"end_header", 0, HEADER)
    if not content.startswith(b"ply") or end < 0:
        raise ValueError("no header of a PLY file")
    start = content.find(b"\n", end) + 1
    lines = [line.split() for line in content[:end].decode("ascii").splitlines()]
    form, elements = "", list[tuple[str, int, list[tuple[str, str]]]]()
    for words in lines:
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            elements.append((words[1], counted(int(words[2]), f"element {words[1]}"), []))
        elif words[:1] == ["property"]:
            # What stands behind the vertices (faces are lists) is not looked at.
            elements[-1][2].append((words[-1], "" if words[1] == "list" else KINDS[words[1]]))
    if form != "ascii" and form not in ORDERS:
        raise ValueError(f"format {form!r}")
    if start == 0:
        raise ValueError("nothing behind the header")
    for name, count, properties in elements:
        if any(not kind for _, kind in properties):
            raise ValueError(f"element {name} with a list before or in the vertices")
        if len({key for key, _ in properties}) < len(properties) or not properties:
            raise ValueError(f"properties of element {name}: none, or one twice")
        if form == "ascii":
            rows, start = _ascii(content, start, count, len(properties))
            columns = {key: rows[:, place] for place, (key, _) in enumerate(properties)}
        else:
            layout = np.dtype([(key, ORDERS[form] + kind) for key, kind in properties])
            if start + count * layout.itemsize > len(content):
                raise ValueError(f"{len(content) - start} bytes for {count} of element {name}")
            table = np.frombuffer(content, layout, count, start)
            columns, start = {key: table[key] for key in layout.names or ()}, start + count * layout.itemsize
        if name == "vertex":
            wanted = ["x", "y", "z", *(["nx", "ny", "nz"] if {"nx", "ny", "nz"} <= columns.keys() else [])]
            return np.stack([columns[key] for key in wanted], axis=1).astype(np.float64)
    raise ValueError("no vertices")


def _ascii(content: bytes, start: int, count: int, width: int) -> tuple[Array, int]:
    """Return the next `count` lines of `width` numbers, and where they end."""
    numbers, at = list[bytes](), start
    for _ in range(count):
        end = content.find(b"\n", at)
        end = len(content) if end < 0 else end
        words = content[at:end].split()
        if len(words) != width:
            raise ValueError(f"{len(words)} numbers in a line of {width}")
        numbers += words
        at = end + 1
    return np.array(numbers, dtype=np.float64).reshape(count, width), at
