"""Exact epsilon, its filter, volume and wrenches against qhull, on grasps of our own hand and on other sets.

    python -m benchmarks.epsilon [--golden golden_autograsp.json] [--rounds 7] [--json epsilon.json]

Variants take turns: CPU time of one core per grasp, ratios by round (median, least and largest of the rounds).
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial import ConvexHull, QhullError

from benchmarks.interleaved import Comparison, compare, record
from dexgrasp.closing import Closer
from dexgrasp.dataset.proposals import opened
from dexgrasp.distance import DistanceField
from dexgrasp.geometry import inverse
from dexgrasp.hand import Hand
from dexgrasp.objects import Object, load_objects
from dexgrasp.plugins import load_hand
from dexgrasp.quality import epsilon, reaches
from dexgrasp.quality_gradient import differentiable_epsilon, epsilon_bound, support_directions
from dexgrasp.seeds import stream
from dexgrasp.wrench_model import WrenchModel

THRESHOLD = 0.05
OBJECTS = 8
Cases = list[tuple[WrenchModel, np.ndarray, np.ndarray]]
"""Models with contacts and normals (N, F, 3) of their grasps."""


def closings(hand: Hand, item: Object, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Close hands whose palm looks at points of the surface; return contacts and normals where all fingers touch."""
    rng = stream(0, "benchmark", item.name)
    points, faces = trimesh.sample.sample_surface(item.mesh, count, seed=0)
    frames = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    z = torch.from_numpy(-np.asarray(item.mesh.face_normals[faces]))
    x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.from_numpy(rng.normal(size=(count, 3)))), dim=1)
    frames[:, :3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=2)
    frames[:, :3, 3] = torch.from_numpy(np.asarray(points)) - z * torch.from_numpy(rng.uniform(0, 0.12, (count, 1)))
    low, high = hand.limits.unbind(dim=1)
    joints = low + (high - low) * torch.from_numpy(rng.random((count, len(low))))
    closure = Closer(hand).close(
        DistanceField.build(item.mesh), frames @ inverse(hand.base_T_palm.double()), opened(hand, joints)
    )
    kept = closure.touched.all(dim=1)
    return closure.contacts[kept].double().numpy(), closure.normals[kept].double().numpy()


def scattered(fingers: int, count: int) -> Cases:
    """Contacts all over a ball with rough normals: the whole hull matters, nothing is rejected early."""
    rng = stream(0, "scattered", fingers)
    contacts = rng.normal(size=(count, fingers, 3))
    contacts /= np.linalg.norm(contacts, axis=-1, keepdims=True)
    normals = contacts + 0.3 * rng.normal(size=contacts.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return [(WrenchModel((0, 0, 0), 1.0), contacts * rng.uniform(0.5, 1, (count, fingers, 1)), normals)]


def of_graspit(path: Path, fingers: range) -> list[np.ndarray]:
    """Return the wrench sets of GraspIt!'s grasps with so many contacts."""
    golden = [grasp["contacts"] for grasp in json.loads(path.read_text(encoding="utf-8"))]
    return [np.array([w for c in grasp for w in c["wrenches"]])[None] for grasp in golden if len(grasp) in fingers]


def qhull(sets: np.ndarray, options: str | None) -> int:
    for points in sets:
        try:
            hull = ConvexHull(points, qhull_options=options)
            max(0.0, -hull.equations[:, -1].max())
        except QhullError:
            pass  # flat, without joggling
    return len(sets)


def measure(sets: list[np.ndarray], sample: int, rounds: int) -> tuple[Comparison, dict[str, Any]]:
    """Compare on wrench sets; qhull on a random `sample` of them."""
    total = sum(map(len, sets))
    few = [sets[i][j] for i, j in _drawn(sets, sample)]

    def run(work: Any) -> Any:
        return lambda: sum(len(work(part)) for part in sets)

    found = compare(
        {
            "exact": run(epsilon),
            "filter": run(lambda part: reaches(part, THRESHOLD)),
            "exact above threshold": run(lambda part: epsilon(part, THRESHOLD)),
            "qhull QJ": lambda: qhull(few, "QJ"),
            "qhull": lambda: qhull(few, None),
        },
        rounds,
    )
    values = np.concatenate([epsilon(part) for part in sets])
    ratios = {
        f"{ours} / {reference}": found.ratio(ours, reference)
        for ours in ("exact", "filter", "exact above threshold")
        for reference in ("qhull QJ", "qhull")
    }
    shares = {"closure": float((values > 0).mean()), "above threshold": float((values >= THRESHOLD).mean())}
    return found, {"sets": total, "wrenches": sets[0].shape[1], **shares, "rates": found.rates, "ratios": ratios}


def _drawn(sets: list[np.ndarray], sample: int) -> list[tuple[int, int]]:
    every = [(i, j) for i, part in enumerate(sets) for j in range(len(part))]
    return [every[k] for k in stream(0, "sample").permutation(len(every))[:sample]]


def measure_models(cases: Cases, rounds: int) -> dict[str, Any]:
    """Contacts of grasps with closure to figures, by models, and what differentiable forms cost and miss."""
    models = [
        (name, [(WrenchModel(model.origin, model.scale, **fields), *rest) for model, *rest in cases])
        for name, fields in {"hard, L1": {}, "soft, L1": {"torsion": 0.01}, "hard, linf": {"hull": "linf"}}.items()
    ]
    variants = {"wrenches": lambda: sum(len(model.wrenches(*rest)) for model, *rest in cases)}
    tensors = [(m, torch.from_numpy(c).requires_grad_(), torch.from_numpy(n)) for m, c, n in cases]
    variants["wrenches, differentiable"] = lambda: sum(len(model.wrenches(*rest)) for model, *rest in tensors)
    for name, own in models:
        variants[f"contacts to epsilon, {name}"] = lambda own=own: sum(len(m.epsilon(*r).values) for m, *r in own)
        variants[f"contacts to filter, {name}"] = lambda own=own: sum(len(m.reaches(*r, THRESHOLD)) for m, *r in own)
    few = [(model, contacts[:50], normals[:50]) for model, contacts, normals in cases]
    variants["volume, hard, L1"] = lambda: sum(len(model.volume(*rest).values) for model, *rest in few)
    sets = torch.from_numpy(np.concatenate([model.wrenches(*rest) for model, *rest in few]))
    variants["differentiable, forward"] = lambda: len(differentiable_epsilon(sets))
    variants["bound, its directions too"] = lambda: len(epsilon_bound(sets, support_directions(sets)))
    found = compare(variants, rounds)
    exact, bound = epsilon(sets), epsilon_bound(sets, support_directions(sets))
    above = exact > 0.01
    loose = (bound / exact)[above].double() - 1
    return {
        "rates": found.rates,
        "bound's excess over epsilon > 0.01": {
            "median": float(loose.median()),
            "90 %": float(loose.quantile(0.9)),
            "sets": int(above.sum()),
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--golden", type=Path, help="GraspIt!'s grasps, as a further collection")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", help="where the figures go; default epsilon.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    hand = load_hand("barrett")
    objects = load_objects({"kind": "procedural", "split": "test", "count": OBJECTS, "seed": 0})
    cases: Cases = []
    for item in objects:
        contacts, normals = closings(hand, item, 4000)
        if len(contacts):
            cases.append((WrenchModel(tuple(item.com), item.radius), contacts, normals))
    every = [model.wrenches(*rest) for model, *rest in cases]
    closed = [epsilon(part) > 0 for part in every]
    collections = {
        "BarrettHand closings, 3 contacts": (every, 100),
        "those of them with closure": ([part[rows] for part, rows in zip(every, closed, strict=True)], 100),
    }
    cases = [(model, c[rows], n[rows]) for (model, c, n), rows in zip(cases, closed, strict=True)]
    for fingers, count, sample in ((4, 1000, 40), (8, 200, 8), (12, 120, 4), (18, 80, 3)):
        sets = [model.wrenches(*rest) for model, *rest in scattered(fingers, count)]
        collections[f"scattered over a ball, {fingers} contacts"] = (sets, sample)
    if args.golden:
        for name, fingers in {"3": range(3, 4), "4 to 8": range(4, 9), "9 to 24": range(9, 25)}.items():
            sets = of_graspit(args.golden, fingers)
            few = max(2, 60 // fingers.start**2)
            collections[f"GraspIt!'s grasps, {name} contacts"] = ([np.repeat(s, 20, axis=0) for s in sets], few)
    figures: dict[str, Any] = {}
    print(f"{'1/s per core':42s}{'closure':>9s}{'exact':>10s}{'filter':>10s}{'QJ':>8s}  exact / QJ      filter / QJ")
    for name, (sets, sample) in collections.items():
        found, figures[name] = measure(sets, sample, args.rounds)
        rates = [found.rates[key].median for key in ("exact", "filter", "qhull QJ")]
        ratios = [figures[name]["ratios"][f"{ours} / qhull QJ"] for ours in ("exact", "filter")]
        told = "  ".join(f"{middle:5.0f} ({low:.0f}..{high:.0f})" for middle, low, high in ratios)
        print(f"{name:42s}{figures[name]['closure']:9.0%}{rates[0]:10,.0f}{rates[1]:10,.0f}{rates[2]:8,.0f}  {told}")
    figures["models"] = measure_models(cases, args.rounds)
    for name, rate in figures["models"]["rates"].items():
        print(f"{name:42s}{rate.median:19,.0f}")
    print("bound's excess over epsilon > 0.01:", figures["models"]["bound's excess over epsilon > 0.01"])
    print(record("epsilon", figures, args.json))


if __name__ == "__main__":
    main()
