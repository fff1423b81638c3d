"""Progress of a loop: nothing is lost, and it says how fast and how long."""

import time

import pytest

from dexgrasp import progress


def test_items_pass_through_and_the_end_is_told(capsys):
    assert list(progress.track(range(5), "scenes")) == list(range(5))
    line = capsys.readouterr().err
    assert line.startswith("scenes: 5 in ") and line.rstrip().endswith("/s") and line.count("\n") == 1


def test_lines_come_now_and_then_with_the_time_left(capsys, monkeypatch):
    monkeypatch.setattr(progress, "PAUSE", 0.02)
    for _ in progress.track(iter(range(4)), "views", total=4):
        time.sleep(0.03)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("views: 1/4") and lines[0].endswith("s left")
    assert lines[-1].startswith("views: 4 in")


def test_unknown_totals_are_counted(capsys, monkeypatch):
    monkeypatch.setattr(progress, "PAUSE", 0.0)
    assert len(list(progress.track((i for i in range(3)), "steps"))) == 3
    assert "steps: 2, " in capsys.readouterr().err


def test_an_error_within_the_loop_is_not_swallowed(capsys):
    with pytest.raises(ZeroDivisionError):
        for item in progress.track([1, 0], "x"):
            1 / item


def test_a_bar_on_a_terminal_passes_items_through(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert list(progress.track(range(3), "bar")) == [0, 1, 2]
    assert "bar" in capsys.readouterr().err
