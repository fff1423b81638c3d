"""Runs the jobs of a study one after another, each in a process and a folder of its own; what is done is kept."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from dexgrasp.child import end_with_parent
from dexgrasp.progress import track
from dexgrasp.study.study import Job

DONE = ("results.json", "fidelity.json")
"""A folder that holds one of these is a finished run."""
LOG = "output.txt"
PATIENCE = 60.0
"""Seconds that a job has, after Ctrl-C, to save."""


def finished(folder: Path) -> bool:
    """Whether the run in a folder has ended well."""
    return any((folder / name).is_file() for name in DONE)


def work(jobs: Sequence[Job]) -> dict[str, str]:
    """Run the jobs that are not finished; return what went wrong, by job.

    A job that fails stops no other but those that need it. Ctrl-C lets the running one save.
    """
    failed: dict[str, str] = {}
    for job in track(jobs, "study"):
        if finished(job.folder):
            continue
        if missing := [folder for folder in job.needs if not finished(folder)]:
            failed[job.name] = f"needs {missing[0]}"
            continue
        print(f"{job.name}: {job.folder}", file=sys.stderr, flush=True)
        status = _run(job)
        if status:
            failed[job.name] = f"status {status}: {_last(job.folder)}"
            print(f"{job.name} failed, {failed[job.name]}", file=sys.stderr, flush=True)
    return failed


def _run(job: Job) -> int:
    job.folder.mkdir(parents=True, exist_ok=True)
    again = job.words[0] == "train" and (job.folder / "config.yaml").is_file()
    words = ["train", f"resume={job.folder}"] if again else [*job.words, f"hydra.run.dir={job.folder}"]
    command = [sys.executable, "-m", "dexgrasp", *words]
    # Set by this very command, for wording of its own; a job would show tracebacks.
    own_environment = {key: value for key, value in os.environ.items() if key != "HYDRA_FULL_ERROR"}
    with (job.folder / LOG).open("a") as log:
        # A session of its own: Ctrl-C reaches it once, from here.
        child = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=own_environment,
            start_new_session=True,
            preexec_fn=end_with_parent,
        )
        try:
            return child.wait()
        except BaseException:
            child.send_signal(signal.SIGINT)
            try:
                child.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                child.kill()
            raise


def _last(folder: Path) -> str:
    """Return what a job said went wrong, or the last line that it wrote."""
    lines = [line.strip() for line in (folder / LOG).read_text(errors="replace").splitlines() if line.strip()]
    told = next((" ".join(lines[i:]) for i in range(len(lines) - 1, -1, -1) if ": expected " in lines[i]), None)
    return told or (lines[-1] if lines else "it wrote nothing")
