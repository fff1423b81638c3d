"""Whether a dataset is what it says: every byte, the form of every item, and some grasps tested anew."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from dexgrasp.dataset import stages
from dexgrasp.dataset.clutter import feasible
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.store import Store
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import opened
from dexgrasp.grasps import Grasps
from dexgrasp.seeds import stream
from dexgrasp.wrench_model import WrenchModel

SCHEMAS: dict[str, dict[str, tuple[str | int, ...]]] = {
    "objects": {"vertices": ("v", 3), "faces": ("f", 3), "com": (3,), "size": (2,), "stable_poses": ("k", 4, 4)},
    "grasps": {
        "pose": ("n", 4, 4),
        "joints": ("n", "j"),
        "contacts": ("n", "f", 3),
        "normals": ("n", "f", 3),
        "finger": ("n",),
        "object": ("n",),
        "quality": ("n",),
    },
    "verdicts": {"grasp": ("t",), "reason": ("t",), "height": ("t",), "resting": ("t",), "poses": ("k", 4, 4)},
    "scenes": {"poses": ("o", 4, 4), "object": ("o",), "grasp_object": ("g",), "grasp": ("g",)},
    "views": {"points": ("p", 3), "normals": ("p", 3), "instance": ("p",), "world_T_camera": (4, 4)},
    "labels": {"point": ("k",), "finger": ("k",), "parameters": ("k", "p"), "quality": ("k",), "true": ("k",)},
}
"""Tensors that items of a stage have at least, and their shapes; equal letters are equal numbers."""
EPSILON = 1e-6
"""Most that epsilon may differ when it is computed from the stored contacts, which are in single precision."""
MOVED = 1e-3
"""Most that a fingertip's contact may lie from the stored one after closing again, m: contacts on a flat pad slide."""
DEEPER = 5e-5
"""Allowance on the deepest overlap, m."""
SHALLOW, AGAIN = 0.999, 0.95
"""Least shares of grasps that are no deeper, and that close again as stored. Single precision moves what is at a limit
across it, and closing starts from the opening with which grasps are carried out, from where a few meet an edge before.
"""


@dataclass(frozen=True)
class Check:
    """What one kind of test found."""

    name: str
    good: bool
    found: str

    def __str__(self) -> str:
        return f"{'good' if self.good else 'BAD '}  {self.name}: {self.found}"


def checked(store: Store) -> str:
    """Check every shard against its sha256 and every item against the schema of its stage; return what was seen.

    Raises DexgraspError at the first that is not as it was written.
    """
    shards = store.verify()
    wanted = SCHEMAS.get(store.manifest["kind"], {})
    for item in store:
        _fits(item, wanted, str(store.folder))
    return f"{shards} shards are as they were written, {len(store)} items of the right form"


def _fits(item: Item, wanted: dict[str, tuple[str | int, ...]], where: str) -> None:
    sizes: dict[str, int] = {}
    for name, shape in wanted.items():
        value = item.tensors.get(name)
        found = None if value is None else tuple(value.shape)
        good = found is not None and len(found) == len(shape)
        for size, letter in zip(found or (), shape, strict=False):
            good = good and size == (letter if isinstance(letter, int) else sizes.setdefault(letter, size))
        if good and value is not None and value.is_floating_point() and name not in ("contacts", "normals"):
            good = bool(value.isfinite().all())
        if not good:
            found_text = "nothing" if found is None else f"shape {found}, or numbers that are not finite"
            raise DexgraspError(f"{name} {shape} in item {item.key} of {where}", found_text, "make the store again")


def rechecked(dataset: Dataset, grasps: int, scenes: int, seed: int = 0) -> Iterator[Check]:
    """Test some grasps and scenes again, as far as their stages are there."""
    if "grasps" in dataset.folders and grasps:
        yield from _grasps(dataset, grasps, seed)
    if "scenes" in dataset.folders and scenes:
        yield _scenes(dataset, scenes, seed)


def _grasps(dataset: Dataset, count: int, seed: int) -> Iterator[Check]:
    settings = stages.settings_of(dataset).synthesis
    kept = np.array([len(dataset.grasps(i)) for i in range(len(dataset.store("grasps")))])
    if not kept.sum():
        yield Check("grasps", True, "none are there")
        return
    drawn = np.sort(stream(seed, "verify").choice(kept.sum(), min(count, kept.sum()), replace=False))
    owner = np.searchsorted(np.cumsum(kept), drawn, side="right")
    errors, depths, moved, closed, least = [], [], [], [], []
    for number in np.unique(owner):
        own = dataset.grasps(int(number))[torch.from_numpy(drawn[owner == number] - (kept.cumsum() - kept)[number])]
        own = own.to(torch.float64)
        body = dataset.body(int(number))
        model = WrenchModel.about(body, dataset.hand, settings.friction, settings.edges, settings.torsion)
        errors.append((torch.as_tensor(model.epsilon(own.contacts, own.normals).values) - own.quality).abs())
        least.append(own.quality)
        start = opened(dataset.hand, own.joints, settings.opening, own.touching)
        closure = dataset.closer.close(body.field, own.pose, start, centred=True, touching=own.touching)
        depths.append(closure.penetration)
        away = torch.linalg.vector_norm(closure.contacts - own.contacts, dim=-1).nan_to_num(nan=torch.inf)
        moved.append(torch.where(own.touching, away, 0.0).max(dim=1).values)
        closed.append(((closure.touched & closure.on_tip) | ~own.touching).all(dim=1))
    error, depth, away = (torch.cat(values) for values in (errors, depths, moved))
    quality, shut = torch.cat(least), torch.cat(closed)
    total = f"of {len(error)} grasps"
    yield Check("epsilon", bool(error.max() <= EPSILON), f"from the contacts, off by {error.max():.1e} at most {total}")
    low = float(quality.min())
    yield Check(
        "quality", low >= settings.epsilon - EPSILON, f"at least {low:.4f} {total}, {settings.epsilon} is wanted"
    )
    deep = float((depth <= settings.penetration + DEEPER).double().mean())
    limit, deepest = 1e3 * settings.penetration, 1e3 * float(depth.max())
    found = f"{deep:.1%} {total} reach no deeper than {limit:g} mm, the deepest {deepest:.2f} mm"
    yield Check("penetration", deep >= SHALLOW, found)
    again = shut & (away <= MOVED)
    share = float(again.double().mean())
    found = (
        f"{share:.1%} {total} touch again with every tip within {1e3 * MOVED:g} mm, median {1e3 * away.median():.3f} mm"
    )
    yield Check("closing", share >= AGAIN, found)


def _scenes(dataset: Dataset, count: int, seed: int) -> Check:
    settings = stages.settings_of(dataset)
    chosen = stream(seed, "verify scenes").permutation(dataset.scenes)[:count]
    tested = blocked = strange = 0
    for number in map(int, chosen):
        scene, grasps = dataset.scene(number), dataset.scene_grasps(number)
        numbers = dataset.scene_objects(number).tolist()
        grasps = _carried(dataset, number, grasps)
        obstacles = [dataset.field(i) for i in numbers]
        free = feasible(
            dataset.shape, dataset.hand, grasps, scene.poses.double(), obstacles, settings.approach, scene.fixtures
        )
        tested += len(free)
        blocked += int((~free).sum())
        strange += int((grasps.object >= len(numbers)).sum())
    found = f"{blocked} of {tested} grasps of {len(chosen)} scenes collide, {strange} belong to no object of theirs"
    return Check("scenes", blocked == strange == 0, found)


def _carried(dataset: Dataset, number: int, grasps: Grasps) -> Grasps:
    """Return the scene's grasps carried in double precision, as they were when the scene was made."""
    item = dataset.store("scenes")[number].tensors
    poses = torch.cat(
        [
            item["poses"][row] @ dataset.grasps(owner).pose[item["grasp"][item["grasp_object"] == row].long()].double()
            for row, owner in enumerate(item["object"].tolist())
        ]
    )
    return grasps.to(torch.float64).replace(pose=poses)
