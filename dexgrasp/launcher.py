"""Hydra launcher `local`: the jobs of a multirun as processes of their own, a few at a time.

A process per job, not a pool: a job may itself use every kind of parallelism, a crash takes only itself, and its
output goes to a file in its run folder instead of mixing with the others'.
"""

import logging
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from dexgrasp.errors import DexgraspError

log = logging.getLogger(__name__)
NAME = "hydra_plugins.dexgrasp.LocalLauncher"
"""Hydra takes launchers from its namespace package only; a module there would leak into every Hydra app of the
environment, so the class lies here and is registered under such a name."""
PATIENCE = 60.0
"""Seconds that a job has, after Ctrl-C, to write its checkpoint."""


@dataclass
class LocalLauncherConf:
    """Options of ``hydra/launcher=local``."""

    _target_: str = NAME
    workers: int = 0
    """Jobs at a time; 0 = one for every two cores, at least one."""


def register() -> None:
    """Make ``hydra/launcher=local`` known to Hydra."""
    ConfigStore.instance().store(group="hydra/launcher", name="local", node=LocalLauncherConf, provider="dexgrasp")
    Plugins.instance().class_name_to_class[NAME] = LocalLauncher


class LocalLauncher(Launcher):
    """Runs jobs as ``python -m dexgrasp.launcher <job file>``."""

    config: DictConfig
    hydra_context: HydraContext
    task_function: TaskFunction

    def __init__(self, workers: int = 0) -> None:
        self.workers = workers or max(1, (os.cpu_count() or 1) // 2)

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs, each whatever becomes of the others; returns in the jobs' order."""
        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        common = set.intersection(*map(set, job_overrides)) if len(job_overrides) > 1 else set()
        waiting = [self._prepare(list(job), initial_job_idx + i, common) for i, job in enumerate(job_overrides)]
        jobs = list(waiting)
        log.info(f"{len(jobs)} jobs, {self.workers} at a time, output in {jobs[0].folder.parent}/*/{Job.OUTPUT}")
        running: list[Job] = []
        try:
            while waiting or running:
                while waiting and len(running) < self.workers:
                    running.append(waiting.pop(0))
                    running[-1].start(self.workers)
                running = [job for job in running if not job.ended()]
                time.sleep(0.1)
        except BaseException:
            for job in waiting:
                job.forget()
            _stop(running)
            raise
        failed = [job for job in jobs if job.returned.status is JobStatus.FAILED]
        if failed:
            raise DexgraspError(
                f"all {len(jobs)} runs of the multirun to succeed",
                f"{len(failed)} failed"
                + "".join(f"\n         {job}: {_told(job.returned._return_value)}" for job in failed),
                f"see {Job.OUTPUT} in the folder of each; the results of the others are kept",
            )
        return [job.returned for job in jobs]

    def _prepare(self, overrides: list[str], number: int, common: set[str]) -> "Job":
        config = self.hydra_context.config_loader.load_sweep_config(self.config, overrides)
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        folder = Path(str(OmegaConf.select(config, "hydra.sweep.dir"))) / str(
            OmegaConf.select(config, "hydra.sweep.subdir")
        )
        folder.mkdir(parents=True, exist_ok=True)
        label = " ".join(word for word in filter_overrides(overrides) if word not in common)
        job = Job(label or "(defaults)", number, folder.absolute(), overrides)
        state = (self.hydra_context, self.task_function, config, Singleton.get_state())
        job.file.write_bytes(cloudpickle.dumps(state))
        return job


class Job:
    """One run of a multirun, in a process of its own session, so that Ctrl-C reaches it once and through us."""

    OUTPUT = "output.txt"

    def __init__(self, label: str, number: int, folder: Path, overrides: list[str]) -> None:
        self.label, self.number, self.folder, self.overrides = label, number, folder, overrides
        self.file, self.answer = folder / ".job.pickle", folder / ".result.pickle"
        self.began = 0.0
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, workers: int) -> None:
        """Start the process; threads are divided among the jobs that run together."""
        log.info(f"{self} starts")
        threads = str(max(1, (os.cpu_count() or 1) // workers))
        environment = {"OMP_NUM_THREADS": threads, "OMP_WAIT_POLICY": "PASSIVE", **os.environ}
        self.began = time.monotonic()
        with open(self.folder / self.OUTPUT, "wb") as output:
            command = [sys.executable, "-m", "dexgrasp.launcher", str(self.file), str(self.answer)]
            self.process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, env=environment, start_new_session=True
            )

    def __str__(self) -> str:
        return f"#{self.number} ({self.label})"

    def ended(self) -> bool:
        """Whether the process is over; takes in its result and says so once."""
        if self.process is None or self.process.poll() is None:
            return False
        self.returned = self._result()
        verdict = "ends" if self.returned.status is JobStatus.COMPLETED else "FAILED"
        log.info(f"{self} {verdict} after {time.monotonic() - self.began:.0f} s")
        return True

    def _result(self) -> JobReturn:
        """What the job left, or a failure where it died without leaving anything."""
        try:
            returned: JobReturn = cloudpickle.loads(self.answer.read_bytes())
            self.answer.unlink()
            return returned
        except Exception:
            assert self.process is not None
            status = f"exit status {self.process.returncode}, see {self.folder / self.OUTPUT}"
            returned = JobReturn(overrides=self.overrides, status=JobStatus.FAILED)
            returned.return_value = RuntimeError(status)
            return returned

    def forget(self) -> None:
        """Take away what a job that never began has prepared."""
        self.file.unlink(missing_ok=True)
        with suppress(OSError):  # the user's, from before
            self.folder.rmdir()

    def interrupt(self) -> None:
        """Pass on Ctrl-C."""
        if self.process is not None:
            self.process.send_signal(signal.SIGINT)

    def wait(self, seconds: float) -> None:
        """Wait until the process is over, at most so long."""
        with suppress(subprocess.TimeoutExpired):
            if self.process is not None:
                self.process.wait(seconds)

    def kill(self) -> None:
        """End the process where it still runs."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _stop(jobs: Sequence[Job]) -> None:
    """Interrupt all jobs at once, so that they save what they have; a second Ctrl-C ends them."""
    try:
        for job in jobs:
            job.interrupt()
        log.info(f"{len(jobs)} runs are interrupted and save what is done; Ctrl-C again ends them at once")
        until = time.monotonic() + PATIENCE
        for job in jobs:
            job.wait(until - time.monotonic())
            log.info(f"{job} stopped, see {job.folder / Job.OUTPUT}")
    finally:
        for job in jobs:
            job.kill()


def _told(error: Any) -> str:
    return " ".join(str(error).split()) if isinstance(error, DexgraspError) else repr(error)


def run(file: Path, answer: Path) -> None:
    """Body of a job's process: restore Hydra's state, run, leave the result."""
    context, task, config, singletons = cloudpickle.loads(file.read_bytes())
    file.unlink()
    Singleton.set_state(singletons)
    setup_globals()
    try:
        returned: Any = run_job(
            hydra_context=context,
            task_function=task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
    except KeyboardInterrupt:  # the command has said what there is to say
        sys.exit(130)
    if returned.status is JobStatus.FAILED:
        traceback.print_exception(returned._return_value)
    answer.write_bytes(cloudpickle.dumps(returned))


if __name__ == "__main__":
    run(Path(sys.argv[1]), Path(sys.argv[2]))
