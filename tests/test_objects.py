"""Objects, sets of them, their round trips."""

import pickle

import numpy as np
import pytest
import torch

from dexgrasp.errors import DexgraspError
from dexgrasp.objects import ObjectSet, load_objects, object_from_tensors, object_to_tensors, procedural, shape


@pytest.fixture(scope="module")
def few() -> ObjectSet:
    return load_objects({"kind": "procedural", "split": "train", "count": 6, "seed": 3})


def test_set_is_found_by_index_and_name(few: ObjectSet) -> None:
    assert len(few) == 6 and len(set(few.names)) == 6
    for place, name in enumerate(few.names):
        assert few[name] is few[place]
    assert few[1:3].names == few.names[1:3]
    with pytest.raises(DexgraspError, match="mug_999"):
        few["mug_999"]


def test_com_volume_radius_of_known_body() -> None:
    item = shape("box", 0)
    assert np.allclose(item.com, 0, atol=1e-9)
    low, high = item.mesh.bounds
    assert 0.9 * np.prod(high - low) < item.volume < np.prod(high - low)
    assert item.radius == pytest.approx(np.linalg.norm(item.mesh.vertices, axis=1).max())


@pytest.mark.parametrize("family", ["mug", "hammer"])
def test_tensors_round_trip_exactly(family: str) -> None:
    item = shape(family, 1)
    tensors = object_to_tensors(item)
    again = object_from_tensors({key: value.clone() for key, value in tensors.items()})
    back = object_to_tensors(again)
    assert set(back) == set(tensors)
    assert all(torch.equal(back[key], tensors[key]) for key in tensors)
    assert (again.name, again.family, again.source) == (item.name, item.family, item.source)
    assert [len(part.vertices) for part in again.parts] == [len(part.vertices) for part in item.parts]


def test_pickle_is_exact_and_small() -> None:
    item = shape("bottle", 0)
    assert item.stable[1].sum() == pytest.approx(1)
    data = pickle.dumps(item)
    again = pickle.loads(data)
    assert np.array_equal(again.mesh.vertices, item.mesh.vertices)
    assert np.array_equal(again.stable[0], item.stable[0])
    assert len(data) < 60 * len(item.mesh.faces) + 40_000


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ({"kind": "cloud"}, "cloud"),
        ({"kind": "procedural", "split": "validation"}, "validation"),
        ({"kind": "procedural", "sede": 1}, "sede"),
        ({"kind": "folder", "path": "/nowhere/at/all"}, "/nowhere/at/all"),
    ],
)
def test_bad_config_is_one_clear_error(config: dict, match: str) -> None:
    with pytest.raises(DexgraspError, match=match):
        load_objects(config)


def test_sizes_are_drawn_and_repeat() -> None:
    natural = procedural("train", 8)
    varied, again = (procedural("train", 8, 0, (0.5, 2.0), 1.2) for _ in range(2))
    ratios = []
    for plain, item, same in zip(natural, varied, again, strict=True):
        assert item.mesh.is_watertight and np.array_equal(item.mesh.vertices, same.mesh.vertices)
        ratio = item.mesh.extents / plain.mesh.extents
        assert (ratio > 0.5 / 1.21).all() and (ratio < 2 * 1.21).all() and ratio.max() / ratio.min() < 1.45
        assert sum(part.volume for part in item.parts) / item.volume == pytest.approx(
            sum(part.volume for part in plain.parts) / plain.volume, rel=1e-6
        )
        ratios.append(ratio.mean())
    assert max(ratios) > 1.2 and min(ratios) < 0.8
    with pytest.raises(DexgraspError, match=r"objects\.size"):
        procedural("train", 1, 0, (2.0, 1.0))


def test_flat_shapes_have_the_thickness_that_is_drawn() -> None:
    natural = procedural("train", 12)
    flat = procedural("train", 12, thickness=(0.012, 0.03), suffix="_flat")
    assert flat.names == tuple(f"{name}_flat" for name in natural.names)
    for plain, item in zip(natural, flat, strict=True):
        assert item.mesh.is_watertight and np.allclose(item.com, 0, atol=1e-6)
        shortest = plain.mesh.extents.argmin()
        others = np.arange(3) != shortest
        assert item.mesh.extents[others] == pytest.approx(plain.mesh.extents[others])
        assert 0.012 - 1e-9 <= item.mesh.extents[shortest] <= 0.03 + 1e-9
    assert len(set(flat[k].mesh.extents.min() for k in range(12))) == 12
    thin = procedural("train", 12, thickness=(1.0, 2.0))  # nothing is made thicker
    assert all(np.array_equal(a.mesh.vertices, b.mesh.vertices) for a, b in zip(natural, thin, strict=True))
    with pytest.raises(DexgraspError, match=r"objects\.thickness"):
        procedural("train", 1, thickness=(0.02, 0.01))


def test_shapes_of_some_families_are_the_same_as_among_all() -> None:
    every, some = procedural("train", 64), procedural("train", 4, families=["bottle", "box"])
    assert some.names == ("bottle_000", "box_000", "bottle_001", "box_001")
    assert all(np.array_equal(item.mesh.vertices, every[item.name].mesh.vertices) for item in some)
    assert len(procedural("train", families=["box"])) == 3 and len(procedural("test", families=["carton"])) == 1
    assert procedural("train", 2, families=["box", "box"]).names == ("box_000", "box_001")
    for wrong in (["carton"], []):  # held out
        with pytest.raises(DexgraspError, match=r"objects\.families"):
            procedural("train", 1, families=wrong)


def test_several_sets_are_one() -> None:
    one, other = ({"kind": "procedural", "split": split, "count": 2} for split in ("train", "test"))
    both = load_objects({"kind": "several", "sets": {"a": one, "b": other}})
    assert both.names == (*load_objects(one).names, *load_objects(other).names)
    with pytest.raises(DexgraspError, match="different names"):
        load_objects({"kind": "several", "sets": {"a": one, "b": one}})
