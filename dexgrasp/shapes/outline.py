"""Polylines: rounding their corners, cutting and thinning them within a tolerance."""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float64]


def fillet(profile: ArrayLike, cut: float = 0.005, steps: int = 4) -> Points:
    """Round the inner corners of a polyline (K D, m) by parabolas that start `cut` (m) before the corner."""
    line = np.asarray(profile, dtype=float)
    out = [line[:1]]
    t = np.linspace(0, 1, steps + 1)[:, None]
    for before, corner, after in zip(line, line[1:], line[2:], strict=False):
        back, ahead = before - corner, after - corner
        start = corner + back * min(0.5, cut / np.linalg.norm(back))
        end = corner + ahead * min(0.5, cut / np.linalg.norm(ahead))
        out.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    joined = np.vstack([*out, line[-1:]])
    return joined[np.r_[True, np.linalg.norm(np.diff(joined, axis=0), axis=1) > 1e-6]]


def arc(centre: ArrayLike, radius: float, first: float, last: float, steps: int = 12) -> Points:
    """Points (steps+1, 2) of a circular arc from angle `first` to `last` (deg)."""
    angle = np.radians(np.linspace(first, last, steps + 1))
    return np.asarray(centre, dtype=float) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def away(line: Points) -> Points:
    """Distance (K,) of each point of a polyline from the segment between its ends."""
    chord = line[-1] - line[0]
    along = np.clip((line - line[0]) @ chord / max(float(chord @ chord), 1e-18), 0, 1)
    return np.linalg.norm(line - line[0] - along[:, None] * chord, axis=1)


def runs(line: Points, tolerance: float) -> list[slice]:
    """Cut a polyline greedily into runs that leave their chord by `tolerance` at most; neighbours share an end."""
    cuts, start = [], 0
    for end in range(2, len(line)):
        if away(line[start : end + 1]).max() > tolerance:
            cuts.append(slice(start, end))
            start = end - 1
    return [*cuts, slice(start, len(line))]


def thin(line: Points, most: int, tolerance: float) -> tuple[Points, float]:
    """Keep the ends and, one by one, the farthest points until within `tolerance` or `most`; and the error left."""
    kept = [0, len(line) - 1]
    while True:
        gaps = np.zeros(len(line))
        for a, b in pairwise(kept):
            gaps[a : b + 1] = away(line[a : b + 1])
        worst = int(gaps.argmax())
        if gaps[worst] <= tolerance or len(kept) >= most:
            return line[kept], float(gaps[worst])
        kept = sorted({*kept, worst})


def dent(line: Points) -> float:
    """How far (m) an outline (radius, z), z rising, lies inside its own convex hull."""
    upper: list[int] = []
    for index, point in enumerate(line):
        while len(upper) > 1:
            a, b = line[upper[-2]], line[upper[-1]]
            if (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) > 0:  # turns left: convex
                break
            upper.pop()
        upper.append(index)
    return max(float(away(line[a : b + 1]).max()) for a, b in pairwise(upper))
