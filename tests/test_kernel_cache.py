"""Compiled code of one state of the sources is never taken for that of another."""

import os
import subprocess
import sys

import pytest

from dexgrasp.kernel_cache import KEPT, separate

INNER = "from numba import njit\n\n@njit(cache=True)\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from numba import njit\nfrom pack.inner import inner\n\n@njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
)


@pytest.fixture
def clean(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)  # `separate` sets it
    return tmp_path


def test_a_changed_callee_is_compiled_into_its_callers_anew(clean):
    package = clean / "pack"
    package.mkdir()
    (package / "outer.py").write_text(OUTER)
    (package / "__init__.py").write_text(
        "from pathlib import Path\nfrom dexgrasp.kernel_cache import separate\nseparate(Path(__file__).parent)\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = os.pathsep.join([str(clean), *sys.path])
    # kernel_cache alone: importing dexgrasp would set the folder for its own sources first
    call = (
        "import sys, types, importlib.util, dexgrasp, os; os.environ.pop('NUMBA_CACHE_DIR', None);"
        "from pack.outer import outer; print(outer(1))"
    )
    for added in (1, 10):
        (package / "inner.py").write_text(INNER.format(added))
        done = subprocess.run(
            [sys.executable, "-c", call], env=environment, capture_output=True, text=True, timeout=600
        )
        assert done.stdout.split() == [str(1 + added)], done.stderr
    assert len(list((clean / "cache" / "dexgrasp" / "numba").iterdir())) == 3  # dexgrasp's own, and two states


def test_old_states_go_and_a_given_folder_stays(clean, monkeypatch):
    package = clean / "kernels"
    package.mkdir()
    for number in range(KEPT + 2):
        (package / "a.py").write_text(f"# njit {number}\n")
        separate(package)
        monkeypatch.delenv("NUMBA_CACHE_DIR")
    home = clean / "cache" / "dexgrasp" / "numba"
    assert len(list(home.iterdir())) == KEPT
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/given")
    separate(package)
    assert os.environ["NUMBA_CACHE_DIR"] == "/given"


def test_where_nothing_can_be_written_numba_decides(clean, monkeypatch):
    (clean / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(clean / "file"))
    separate(clean)
    assert "NUMBA_CACHE_DIR" not in os.environ
