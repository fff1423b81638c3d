"""Real meshes: layouts, checks, repair; the shared set where it is at hand."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from dexgrasp.convex import convex_parts, deviation
from dexgrasp.errors import DexgraspError
from dexgrasp.meshes import Skip, check_mesh, find_meshes, load_folder, read_mesh
from dexgrasp.objects import load_objects


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DEXGRASP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def _box(path: Path, size: float = 0.08) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box([size, 0.6 * size, 0.5 * size]).export(path)
    return path


def test_flat_folder_with_a_bad_file_each(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    _box(folder / "good.obj")
    _box(folder / "deep" / "er" / "other.stl")
    _box(folder / "millimetres.obj", 80.0)
    (folder / "torn.ply").write_bytes(_box(folder / "whole.ply").read_bytes()[:150])
    (folder / "empty.obj").write_text("")
    (folder / "nan.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n")
    open_box = trimesh.creation.box([0.1, 0.1, 0.1])
    open_box.update_faces(np.arange(12) > 1)
    open_box.export(folder / "open.obj")
    objects, skipped = load_folder(str(folder))
    reasons = dict(skipped)
    assert [item.name for item in objects] == ["good", "other", "whole"]
    assert set(reasons) == {"millimetres", "torn", "empty", "nan", "open"}
    assert "objects.scale=0.001" in reasons["millimetres"]
    assert "NaN" in reasons["nan"] and "not watertight" in reasons["open"]
    assert objects[0].volume == pytest.approx(0.08 * 0.048 * 0.04, rel=1e-5)

    mended, rest = load_folder(str(folder), repair=True, include="open")
    assert not rest and mended[0].mesh.is_volume and "repaired" in mended[0].source
    assert mended[0].volume == pytest.approx(1e-3, rel=1e-3)


def test_include_exclude_count_scale_and_order(tmp_path: Path) -> None:
    for name in ("cup_b", "cup_a", "pan"):
        _box(tmp_path / "set" / f"{name}.obj", 80.0)
    load = {"path": str(tmp_path / "set"), "scale": 1e-3}
    assert [item.name for item in load_folder(**load, exclude=["pan"])[0]] == ["cup_a", "cup_b"]
    assert [item.name for item in load_folder(**load, include="cup*", count=1)[0]] == ["cup_a"]
    with pytest.raises(DexgraspError, match="included"):
        load_folder(**load, include="spoon*")


def test_one_folder_at_two_scales_is_one_set(tmp_path: Path) -> None:
    _box(tmp_path / "set" / "cup.obj", 80.0)
    one = {"kind": "folder", "path": str(tmp_path / "set"), "scale": 1e-3}
    both = load_objects(
        {"kind": "several", "sets": {"as_is": one, "larger": one | {"scale": 1.3e-3, "suffix": "_large"}}}
    )
    assert both.names == ("cup", "cup_large") and {item.family for item in both} == {"cup"}
    assert both["cup_large"].volume == pytest.approx(1.3**3 * both["cup"].volume)
    with pytest.raises(DexgraspError, match="different names"):
        load_objects({"kind": "several", "sets": {"one": one, "other": one}})


def test_nothing_usable_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DexgraspError, match="no folder"):
        load_folder(str(tmp_path / "absent"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(DexgraspError, match=r"\.obj"):
        load_folder(str(tmp_path / "empty"))
    _box(tmp_path / "set" / "big.obj", 80.0)
    with pytest.raises(DexgraspError, match="extent"):
        load_folder(str(tmp_path / "set"))


@pytest.mark.parametrize(
    ("layout", "file", "name"),
    [
        ("ycb", "025_mug/google_16k/textured.obj", "025_mug"),
        ("graspnet", "models/000/nontextured.ply", "000"),
        ("dexgraspnet", "meshdata/core-mug-85/coacd/decomposed.obj", "core-mug-85"),
        ("shapenet", "03797390/1a1c/models/model_normalized.obj", "03797390_1a1c"),
        ("partnet", "7130/textured_objs/original-1.obj", "7130"),
    ],
)
def test_published_layouts(tmp_path: Path, layout: str, file: str, name: str) -> None:
    _box(tmp_path / "set" / file, 0.5)
    for wanted in (layout, "auto"):
        (entry,) = find_meshes(tmp_path / "set", wanted, 0.2)
        assert entry.name == name
        assert read_mesh(entry.files, entry.scale).extents.max() == pytest.approx(0.1)
    if layout == "shapenet":
        with pytest.raises(DexgraspError, match=r"objects\.scale"):
            find_meshes(tmp_path / "set", layout)


def test_partnet_pieces_make_one_body_and_islands_do_not(tmp_path: Path) -> None:
    for shift, name in ((0.0, "a"), (0.03, "b")):
        box = trimesh.creation.box([0.04, 0.04, 0.04]).apply_translation([shift, 0.0, 0.0])
        (tmp_path / "77" / "textured_objs").mkdir(parents=True, exist_ok=True)
        box.export(tmp_path / "77" / "textured_objs" / f"{name}.obj")
    (item,), skipped = load_folder(str(tmp_path), layout="partnet")
    assert not skipped and item.volume == pytest.approx(0.07 * 0.04 * 0.04, rel=1e-4)
    boxes = [trimesh.creation.box([0.02] * 3).apply_translation([x, 0, 0]) for x in (0.0, 0.1)]
    with pytest.raises(Skip, match="2 separate bodies"):
        check_mesh(trimesh.util.concatenate(boxes))


def test_inside_out_is_turned() -> None:
    box = trimesh.creation.box([0.05, 0.05, 0.05])
    box.invert()
    mesh, note = check_mesh(box)
    assert mesh.volume == pytest.approx(1.25e-4) and "inside out" in note


def test_repair_of_an_open_vessel_keeps_its_room() -> None:
    """A cup of no thickness must get a wall, not a lid."""
    cup = trimesh.creation.cylinder(0.04, 0.1, sections=48)
    cup.update_faces(cup.face_normals[:, 2] < 0.9)
    mesh, note = check_mesh(cup, repair=True)
    assert mesh.is_volume and "repaired" in note
    assert not mesh.contains([[0.0, 0.0, 0.0]])[0]


def test_convex_parts_cover_an_l_and_are_cached(cache: Path) -> None:
    import manifold3d

    body = manifold3d.Manifold.cube((0.1, 0.03, 0.02)) + manifold3d.Manifold.cube((0.02, 0.03, 0.08))
    surface = body.to_mesh64()
    mesh = trimesh.Trimesh(surface.vert_properties[:, :3], surface.tri_verts)
    parts = convex_parts(mesh)
    assert 2 <= len(parts) <= 4
    outside, inside = deviation(mesh, parts)
    assert outside.max() < 1e-3 and np.percentile(inside, 95) < 2e-3
    (file,) = (cache / "convex").iterdir()
    again = convex_parts(mesh)
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(parts, again, strict=True))
    file.write_bytes(file.read_bytes()[:100])  # as a crash leaves it
    assert len(convex_parts(mesh)) == len(parts)


def test_shared_meshes_are_found_and_sound(shared: Path) -> None:
    entries = find_meshes(shared / "data" / "objects")
    assert len(entries) == 109 and len({entry.name for entry in entries}) == 109
    for entry in entries[::12]:
        mesh, _ = check_mesh(read_mesh(entry.files, entry.scale))
        assert mesh.is_volume, entry.name
