"""The newcomer's tutorial runs as it stands."""

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STEPS = re.findall(r"```sh\n(.*?)```", (ROOT / "docs/tutorial-your-hand.md").read_text(), re.DOTALL)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_tutorial(tmp_path):
    environment = {**os.environ, "EXAMPLES": str(ROOT / "examples"), "OMP_NUM_THREADS": "1"}
    assert len(STEPS) == 6
    for step in STEPS:
        done = subprocess.run(
            ["bash", "-euc", step], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=800
        )
        assert done.returncode == 0, step + done.stdout[-3000:] + done.stderr[-3000:]
    assert (tmp_path / "looked/hand.png").is_file() and (tmp_path / "toy/model.safetensors").is_file()
    assert (tmp_path / "tried/report.html").is_file() and (tmp_path / "tried/results.json").is_file()
    assert len(list((tmp_path / "data").glob("grasps-*"))) <= 2, "training took the dataset of step 4"
