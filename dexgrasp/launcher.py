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
        waiting = [self._prepare(list(job), initial_job_idx + i) for i, job in enumerate(job_overrides)]
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
            for job in running:
                job.stop()
            raise
        failed = [job for job in jobs if job.returned.status is JobStatus.FAILED]
        if failed:
            raise DexgraspError(
                f"all {len(jobs)} runs of the multirun to succeed",
                f"{len(failed)} failed"
                + "".join(f"\n         {job}: {job.returned._return_value!r}" for job in failed),
                f"see {Job.OUTPUT} in the folder of each; the results of the others are kept",
            )
        return [job.returned for job in jobs]

    def _prepare(self, overrides: list[str], number: int) -> "Job":
        config = self.hydra_context.config_loader.load_sweep_config(self.config, overrides)
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        folder = Path(str(OmegaConf.select(config, "hydra.sweep.dir"))) / str(
            OmegaConf.select(config, "hydra.sweep.subdir")
        )
        folder.mkdir(parents=True, exist_ok=True)
        job = Job(" ".join(filter_overrides(overrides)) or "(defaults)", number, folder.absolute(), overrides)
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

    def stop(self) -> None:
        """Interrupt the job, and end it where it does not obey."""
        if self.process is None:  # Ctrl-C while it was being started
            return
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()


def run(file: Path, answer: Path) -> None:
    """Body of a job's process: restore Hydra's state, run, leave the result."""
    context, task, config, singletons = cloudpickle.loads(file.read_bytes())
    file.unlink()
    Singleton.set_state(singletons)
    setup_globals()
    returned: Any = run_job(
        hydra_context=context,
        task_function=task,
        config=config,
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
    )
    if returned.status is JobStatus.FAILED:
        traceback.print_exception(returned._return_value)
    answer.write_bytes(cloudpickle.dumps(returned))


if __name__ == "__main__":
    run(Path(sys.argv[1]), Path(sys.argv[2]))
