"""How much of a grasp a representation keeps: encode, decode, compare (METHOD section 1)."""

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.dataset.labels import Check
from dexgrasp.dataset.truth import deviation
from dexgrasp.grasps import Grasps
from dexgrasp.representation import Representation

SCHEMA = 2
PERCENTILES = (25, 50, 75, 95)


@dataclass(frozen=True)
class Pairs(Batch):
    """P grasps, each told from one finger at one point."""

    grasp: Int[Tensor, "P"]
    """Which grasp; several pairs may share one."""
    finger: Int[Tensor, "P"]
    point: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]


@dataclass(frozen=True)
class Errors(Batch):
    """What decoding changed, pair by pair."""

    grasp: Int[Tensor, "P"]
    encodable: Bool[Tensor, "P"]
    distance: Float[Tensor, "P"]
    """Between the bases' origins, m."""
    angle: Float[Tensor, "P"]
    """Between the bases, rad."""
    truthful: Bool[Tensor, "P"]
    """Whether the decoded grasp, fingers closed again, passes the checks of synthesis."""


@dataclass(frozen=True)
class Fidelity:
    """One row of the table."""

    representation: str
    numbers: int
    """How many numbers tell a grasp."""
    parameters: int
    """Weights of its heads."""
    normals: str
    """`true`: closing's contact and the surface's normal there; `estimated`: visible points and their normals."""
    told_from: str
    """`any`: every finger (and point) that touches; `best`: per grasp, the one that moves the base least."""
    count: int
    encodable: float
    """Share that can be told at all."""
    truthful: float | None
    """Share that is told and still a grasp; None where nothing was closed again."""
    distance_mm: dict[str, float | None]
    """Percentiles of the base's displacement over what can be told; None where nothing can."""
    angle_deg: dict[str, float | None]


def at_contacts(grasps: Grasps) -> Pairs:
    """Return every contact of every grasp as a point, with closing's normals; untouched fingers are left out."""
    grasp, finger = torch.isfinite(grasps.contacts).all(-1).nonzero(as_tuple=True)
    return Pairs(grasp, finger, grasps.contacts[grasp, finger], grasps.normals[grasp, finger])


@torch.no_grad()
def errors(representation: Representation, grasps: Grasps, pairs: Pairs, check: Check | None = None) -> Errors:
    """Tell and decode every pair; `check` says what is still a grasp (all False without one)."""
    original = grasps[pairs.grasp].replace(finger=pairs.finger)
    targets = representation.encode(pairs.point, pairs.normal, original)
    told = representation.decode(pairs.point, pairs.normal, representation.as_prediction(targets))
    distance, angle = deviation(told, original)
    truthful = torch.zeros_like(targets.encodable)
    if check is not None:
        can = targets.encodable
        truthful[can] = check(told[can], original[can])[0]
    return Errors(pairs.grasp, targets.encodable, distance, angle, truthful)


def best(found: Errors) -> Errors:
    """Return, per grasp, the pair that can be told and moves the base least; truthful where any pair is."""
    moved = torch.where(found.encodable, found.distance, torch.inf)
    order = torch.from_numpy(np.lexsort((moved.numpy(), found.grasp.numpy())))
    _, first = np.unique(found.grasp[order].numpy(), return_index=True)
    chosen = found[order[torch.from_numpy(first)]]
    return chosen.replace(truthful=torch.isin(chosen.grasp, found.grasp[found.truthful]))


def rows(
    name: str, representation: Representation, normals: str, found: Errors, *, checked: bool
) -> Iterator[Fidelity]:
    """Yield the table's two rows of one representation and kind of normals."""
    parameters = sum(each.numel() for each in representation.parameters())
    for told_from, chosen in (("any", found), ("best", best(found))):
        can = chosen.encodable
        yield Fidelity(
            representation=name,
            numbers=representation.size,
            parameters=parameters,
            normals=normals,
            told_from=told_from,
            count=len(chosen),
            encodable=_share(can),
            truthful=_share(chosen.truthful) if checked else None,
            distance_mm=_percentiles(chosen.distance[can] * 1e3),
            angle_deg=_percentiles(chosen.angle[can].rad2deg()),
        )


def write(table: Sequence[Fidelity], folder: Path, notes: dict[str, object]) -> None:
    """Write results.json (schema 2: `notes` and `rows`), fidelity.md and fidelity.csv."""
    content = {"schema": SCHEMA, "kind": "fidelity", **notes, "rows": [asdict(row) for row in table]}
    (folder / "results.json").write_text(json.dumps(content, indent=1) + "\n")
    with (folder / "fidelity.csv").open("w", newline="") as file:
        csv.writer(file).writerows([HEADER, *map(cells, table)])
    lines = [HEADER, ["---"] * len(HEADER), *map(cells, table)]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    (folder / "fidelity.md").write_text(f"# What encode and decode keep of a grasp\n\n{text}\n\n{LEGEND}\n")


HEADER = [
    *("representation", "numbers", "head parameters", "normals", "told from", "count", "encodable %", "truthful %"),
    *(f"mm p{p}" for p in PERCENTILES),
    *(f"deg p{p}" for p in PERCENTILES),
]
LEGEND = (
    "Displacement and rotation of the hand's base over the grasps that can be told. Told from any: every finger that "
    "touches (estimated normals: and every visible point near its contact); best: per grasp, the one that moves the "
    "base least. Head parameters: for point features of size 128. "
    "Truthful: fingers closed again, the decoded grasp passes the checks of synthesis (best: from any)."
)


def cells(row: Fidelity) -> list[str]:
    """Return a row's cells as text, in the order of `HEADER`."""
    truthful = "" if row.truthful is None else f"{100 * row.truthful:.1f}"
    lead = [row.representation, str(row.numbers), str(row.parameters), row.normals, row.told_from, str(row.count)]
    lead += [f"{100 * row.encodable:.1f}", truthful]
    values = (*row.distance_mm.values(), *row.angle_deg.values())
    return lead + ["-" if value is None else f"{value:.2f}" for value in values]


def _share(mask: Tensor) -> float:
    return float(mask.double().mean()) if len(mask) else 0.0


def _percentiles(values: Tensor) -> dict[str, float | None]:
    if not len(values):
        return {f"p{p}": None for p in PERCENTILES}
    return {f"p{p}": float(np.percentile(values.double().numpy(), p)) for p in PERCENTILES}
