"""PCD of the Point Cloud Library: ASCII, binary and compressed."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dexgrasp.sensing.limits import POINTS, counted

Array = NDArray[np.float64]
HEADER = 65_536
WIDEST = 4096
"""Most bytes of a point."""
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


class Pcd(NamedTuple):
    """What a PCD file tells."""

    rows: Array
    """(P, 3) or (P, 6): x, y, z and perhaps normals; NaN where nothing was measured."""
    shape: tuple[int, int] | None
    """Height and width of an organised cloud, row by row."""
    viewpoint: Array
    """(3,) where the sensor stood, in the frame of the points."""


def parse_pcd(content: bytes) -> Pcd:
    """Return the points of a file's content; raises ValueError or KeyError for what is none."""
    header, start = _header(content)
    names = header["FIELDS"]
    kinds = [_kind(letter, int(size)) for letter, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(kinds))]
    if any(not 0 < each <= WIDEST for each in counts) or sum(counts) > WIDEST:
        raise ValueError(f"COUNT {counts}")
    # Padding fields are all called _: only those that are asked for need names.
    layout = np.dtype(
        [(f"{n}_{i}", kind, (c,)) for i, (n, kind, c) in enumerate(zip(names, kinds, counts, strict=True))]
    )
    places = {name: place for place, name in reversed(list(enumerate(names)))}
    count = counted(int(header["POINTS"][0]), "POINTS")
    keys = layout.names or ()
    if header["DATA"] == ["binary"]:
        if start + count * layout.itemsize > len(content):
            raise ValueError(f"{len(content) - start} bytes for {count} points of {layout.itemsize}")
        table = np.frombuffer(content, layout, count, start)
        columns = {name: table[keys[place]][:, 0] for name, place in places.items()}
    elif header["DATA"] == ["binary_compressed"]:
        columns = _compressed(content, start, count, layout, places)
    elif header["DATA"] == ["ascii"]:
        numbers = np.array(content[start:].split(), dtype=np.float64)
        if len(numbers) != count * sum(counts):
            raise ValueError(f"{len(numbers)} numbers for {count} points of {sum(counts)}")
        starts = np.cumsum([0, *counts])
        columns = {name: numbers.reshape(count, sum(counts))[:, starts[place]] for name, place in places.items()}
    else:
        raise ValueError(f"DATA {' '.join(header['DATA'])}, not ascii, binary or binary_compressed")
    wanted = ["x", "y", "z"]
    if {"normal_x", "normal_y", "normal_z"} <= columns.keys():
        wanted += ["normal_x", "normal_y", "normal_z"]
    width, height = (int(header.get(key, ["1"])[0]) for key in ("WIDTH", "HEIGHT"))
    organised = height > 1 and width > 1 and width * height == count
    viewpoint = np.array([float(word) for word in header.get("VIEWPOINT", ["0"] * 7)[:3]])
    if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
        raise ValueError(f"VIEWPOINT {viewpoint}")
    rows = np.stack([columns[name] for name in wanted], axis=1).astype(np.float64)
    return Pcd(rows, (height, width) if organised else None, viewpoint)


def _header(content: bytes) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = content.find(b"\n", start, HEADER)
        if end < 0:
            raise ValueError("no header of a PCD file")
        words = content[start:end].decode("ascii").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
        start = end + 1
    return header, start


def _kind(letter: str, size: int) -> str:
    if size not in SIZES.get(letter, ()):
        raise ValueError(f"TYPE {letter} of SIZE {size}")
    return f"<{letter.lower()}{size}"


def _compressed(
    content: bytes, start: int, count: int, layout: np.dtype, places: dict[str, int]
) -> dict[str, NDArray[np.generic]]:
    """Field by field, all points of each, as one block of LZF."""
    packed, size = (int(each) for each in np.frombuffer(content, "<u4", 2, start))
    if size != count * layout.itemsize or count > POINTS:
        raise ValueError(f"{size} bytes for {count} points of {layout.itemsize}")
    plain = unpack_lzf(content[start + 8 : start + 8 + packed], size)
    keys = layout.names or ()
    offsets = {key: count * layout.fields[key][1] for key in keys}  # type: ignore[index]
    columns = {}
    for name, place in places.items():
        field = layout[keys[place]]
        columns[name] = np.frombuffer(plain, field.base, count * field.shape[0], offsets[keys[place]])
        columns[name] = columns[name].reshape(count, field.shape[0])[:, 0]
    return columns


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Return the `size` bytes that a block of LZF (Lehmann's LibLZF) stands for; raises ValueError for others."""
    plain, at, end = bytearray(), 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:  # so many bytes as they are
            if at + control + 1 > end:
                raise ValueError("compressed data that end too early")
            plain += packed[at : at + control + 1]
            at += control + 1
        else:  # so many bytes again, from so far back
            length = control >> 5
            if at + (1 if length < 7 else 2) > end:
                raise ValueError("compressed data that end too early")
            if length == 7:
                length += packed[at]
                at += 1
            back = len(plain) - ((control & 31) << 8) - packed[at] - 1
            at += 1
            if back < 0:
                raise ValueError("compressed data that point before their beginning")
            length += 2
            piece = plain[back : back + length]
            plain += (piece * (length // max(len(piece), 1) + 1))[:length]
        if len(plain) > size:
            break
    if len(plain) != size:
        raise ValueError(f"compressed data of {len(plain)} bytes, not {size}")
    return bytes(plain)
