"""The packages under examples/ install beside dexgrasp and pass their own three-line tests, as a stranger's would."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted(path.parent for path in (ROOT / "examples").glob("*/pyproject.toml"))


def test_there_is_one_of_each_kind():
    groups = {line for e in EXAMPLES for line in (e / "pyproject.toml").read_text().splitlines() if "dexgrasp." in line}
    assert {f'[project.entry-points."dexgrasp.{kind}"]' for kind in ("hands", "representations", "backbones")} <= groups


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_an_example_installs_and_conforms(example, tmp_path):
    site = tmp_path / "site"
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--target", str(site), str(example)]
    done = subprocess.run([sys.executable, *install], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", str(ROOT))])}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib", "tests"]
    done = subprocess.run(command, cwd=example, env=environment, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "....." in done.stdout, "five laws or more were tried"
