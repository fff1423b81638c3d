"""Objects, sets of them, their round trips."""

import pickle

import numpy as np
import pytest
import torch

from dexgrasp.errors import DexgraspError
from dexgrasp.objects import ObjectSet, load_objects, object_from_tensors, object_to_tensors, shape


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
