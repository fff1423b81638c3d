"""The docs' Python runs as it stands, their links lead somewhere, and the API reference is that of the code."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dexgrasp import checkpoint
from dexgrasp.cloud import prepare
from dexgrasp.model import build_model, save_model
from dexgrasp.plugins import conf_folders, read
from dexgrasp.selection import Selection
from dexgrasp.table import find_table
from dexgrasp.testing.views import seen_scenes

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
OTHERS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
ELSEWHERE = {
    "plugins.md": "test files of packages: those of examples/ are run by continuous integration",
    "your-hand.md": "as plugins.md",
    "export.md": "tests/test_export.py runs graphs",
}
BACKBONE = {"name": "pointnet2", "points": [128, 32], "radii": [0.04, 0.12], "neighbours": [8, 8]}
BACKBONE |= {"widths": [[8, 8], [16, 16]], "decoder": [[16]], "stem": 8}


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    """An untrained network, small."""
    torch.manual_seed(0)
    choices = {kind: next(p for _, f in conf_folders() if (p := f / kind / f"{name}.yaml").is_file())
               for kind, name in (("hand", "barrett"), ("repr", "contact"))}  # fmt: skip
    path = tmp_path_factory.mktemp("weights") / "barrett.safetensors"
    save_model(path, build_model({kind: read(p) for kind, p in choices.items()} | {"backbone": BACKBONE}, points=1024))
    return path


def blocks(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text())


RUN = [page for page in [*PAGES, *OTHERS] if blocks(page) and page.name not in ELSEWHERE]


@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_python_runs_as_it_stands(page, model_file, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checkpoint, "WEIGHTS", model_file.parent)
    # An untrained network's grasps hit everything; they are offered all the same.
    monkeypatch.setattr("dexgrasp.model.Selection", lambda: Selection(depth=None, table=None))
    run = tmp_path / "runs/train/2026-01-01_12-00-00"
    run.mkdir(parents=True)
    (run / "model.safetensors").write_bytes(model_file.read_bytes())
    points = next(seen_scenes(1, 6000))
    known: dict = {"points": points}
    if page.name == "motion.md":
        known["table"] = table = find_table(prepare(points, None, 1024, 0))
        known["up"], known["camera_T_arm"] = table[2, :3], torch.linalg.inv(table) @ look_at_arm()
    if page.name == "tutorial-predict.md":
        depth_image(points, tmp_path / "depth.png")
    if page.name == "datasets.md":
        (tmp_path / "data").symlink_to(request.getfixturevalue("tiny")[0].dataset.root)
    for block in blocks(page):
        exec(compile(block, page.name, "exec"), known)


def look_at_arm() -> torch.Tensor:
    """table_T_arm: beside the scene."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -0.5
    return pose


def depth_image(points: np.ndarray, path: Path) -> None:
    """Write a cloud as the depth image (mm) that the tutorial's intrinsics make of it."""
    image = np.zeros((480, 640), np.uint16)
    column, row = (600 * points[:, 0] / points[:, 2] + 320).round(), (600 * points[:, 1] / points[:, 2] + 240).round()
    inside = (column >= 0) & (column < 640) & (row >= 0) & (row < 480)
    image[row[inside].astype(int), column[inside].astype(int)] = 1000 * points[inside, 2]
    Image.fromarray(image).save(path)


def slug(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower().replace("`", "")).replace(" ", "-")


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{page.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", found.read_text(), re.MULTILINE)
            assert anchor in map(slug, headings), f"{page.name}: {target}"


def test_the_index_names_every_page():
    index = (ROOT / "docs/README.md").read_text()
    assert not [page.name for page in PAGES if page.name != "README.md" and f"({page.name})" not in index]


def test_the_reference_is_that_of_the_code():
    pytest.importorskip("griffe")
    made = runpy.run_path(str(ROOT / "docs/reference.py"))
    assert made["PAGE"].read_text() == made["page"](), "python docs/reference.py"


def test_the_pictures_are_small_and_shown():
    pictures = sorted((ROOT / "docs/images").iterdir())
    assert sum(picture.stat().st_size for picture in pictures) < 2e6
    text = "".join(page.read_text() for page in [*PAGES, *OTHERS])
    assert not [picture.name for picture in pictures if picture.name not in text]
