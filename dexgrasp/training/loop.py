"""The training loop: one network, memory-mapped samples, any number of processes with the same result.

A step's batch is cut into a fixed number of micro-batches; processes share them out and add up their gradients, so the
weights do not depend on how many there are. Batch statistics are those of a micro-batch; the running ones are measured
anew for the averaged weights at the end. The order of views depends on seed and step only, hence resuming is exact.
"""

import copy
import math
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import torch
import torch.multiprocessing
from torch import Tensor, nn

from dexgrasp.checkpoint import read_tensors
from dexgrasp.child import end_with_parent
from dexgrasp.dataset.samples import Batch, Samples
from dexgrasp.device import find_device
from dexgrasp.errors import DexgraspError
from dexgrasp.heap import keep_freed_memory
from dexgrasp.model import GraspNet
from dexgrasp.progress import track
from dexgrasp.seeds import stream
from dexgrasp.training import state
from dexgrasp.training.augmentation import turned, turns
from dexgrasp.training.calibration import calibrate, validate
from dexgrasp.training.feed import Feed
from dexgrasp.training.log import Log
from dexgrasp.training.settings import TrainerSettings, order, schedule


@dataclass
class TrainingSummary:
    """What a training reached."""

    steps: int
    seconds: float
    processes: int
    device: str
    losses: dict[str, float] = field(default_factory=dict)
    validation: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False


def train(
    model: GraspNet, samples: Samples, validation: Samples | None, settings: TrainerSettings, seed: int, folder: Path
) -> TrainingSummary:
    """Train in place and leave the averaged, calibrated weights in `model`.

    `folder` holds metrics.csv, TensorBoard events and the state for resuming; a state that is there is continued.
    Ctrl-C ends after the current step with everything saved.
    """
    device = device_of(settings)
    processes = _processes(settings, device)
    began = time.perf_counter()
    with _interrupt() as stop:
        if processes == 1:
            _run(0, 1, 0, model, samples, validation, settings, seed, folder, device, stop)
        else:
            errors = torch.multiprocessing.get_context("spawn").SimpleQueue()
            work = (processes, _free_port(), model, samples, validation, settings, seed, folder, device, stop)
            context = torch.multiprocessing.start_processes(
                _child,
                args=(errors, *work),
                nprocs=processes,
                start_method="spawn",
                join=False,
            )
            try:
                while not context.join(timeout=1):
                    pass
            except torch.multiprocessing.ProcessRaisedException:
                if errors.empty():
                    raise
                raise errors.get() from None
    saved, notes = read_tensors(folder / state.FILE)
    model.load_state_dict({key.removeprefix("ema."): value for key, value in saved.items() if key.startswith("ema.")})
    step = int(notes["step"])
    summary = TrainingSummary(step, time.perf_counter() - began, processes, str(device))
    summary.losses, summary.interrupted = notes.get("losses", {}), step < settings.steps
    if summary.interrupted:
        return summary
    calibrate(model, samples, settings, seed, device)
    if validation is not None:
        summary.validation = validate(model, validation, settings, device)
    return summary


def _child(rank: int, errors: Any, *work: Any) -> None:
    """One process of several: errors that users shall read go to the parent as they are."""
    end_with_parent()  # or we would train on when it is killed
    try:
        _run(rank, *work)
    except DexgraspError as error:
        errors.put(error)
        raise


def _run(
    rank: int,
    world: int,
    port: int,
    model: GraspNet,
    samples: Samples,
    validation: Samples | None,
    settings: TrainerSettings,
    seed: int,
    folder: Path,
    device: torch.device,
    stop: Any,
) -> None:
    """One process of the training; rank 0 writes."""
    keep_freed_memory()
    if world > 1:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent tells us
        model = copy.deepcopy(model)  # what was sent here lies in memory that all processes share
        torch.set_num_threads(1 if device.type == "cpu" else torch.get_num_threads())
        backend = "nccl" if device.type == "cuda" else "gloo"
        os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
        torch.distributed.init_process_group(backend, rank=rank, world_size=world)
        if device.type == "cuda":
            device = torch.device("cuda", rank)
            torch.cuda.set_device(device)
    torch.manual_seed(int(stream(seed, "training").integers(2**31)))
    model.to(device).train()
    average = {key: value.detach().clone() for key, value in model.state_dict().items()}
    optimizer = _optimizer(model, settings)
    for parameter in model.parameters():  # every process then adds up the same list of gradients
        parameter.grad = torch.zeros_like(parameter)
    step = state.resume(folder / state.FILE, model, average, optimizer, device)
    log = Log(folder, step) if rank == 0 else None
    mine = range(rank, settings.shards, world)
    pending = range(step, settings.steps)
    views = (order(len(samples), settings, seed, done)[shard] for done in pending for shard in mine)
    batches = Feed(samples, device, settings.resident).batches(views)
    losses: dict[str, float] = {}
    for done in track(pending, "training") if rank == 0 else pending:
        step = done + 1
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * schedule(done, settings)
        optimizer.zero_grad(set_to_none=False)
        terms: dict[str, Tensor] = {}
        for shard, batch in zip(mine, islice(batches, len(mine)), strict=True):
            if settings.turn:
                angles = turns(batch, settings.turn, seed, done, shard)
                batch = turned(batch, model.representation, angles)
            for name, value in _backward(model, batch, settings).items():
                terms[name] = terms.get(name, torch.zeros((), device=device)) + value / settings.shards
        halted = _reduce(model, terms, bool(stop.is_set()), world, device)
        nn.utils.clip_grad_norm_(model.parameters(), settings.clip)
        optimizer.step()
        _follow(average, model, min(settings.ema, step / (step + 10)))
        halted = halted or step == settings.steps
        if step % settings.log_every == 0 or halted:
            losses = {name: float(value) for name, value in terms.items()}
            if not all(map(math.isfinite, losses.values())):
                raise DexgraspError("finite losses", f"{losses} at step {step}", "lower trainer.learning_rate")
        if log is not None:
            if step % settings.log_every == 0 or step == settings.steps:
                log.write(step, "train", losses)
            if validation is not None and step % settings.validate_every == 0 and not halted:
                log.write(step, "validation", _validate_average(model, average, validation, samples, settings, seed))
            if step % settings.save_every == 0 or halted:
                state.save(folder / state.FILE, model, average, optimizer, step, losses)
        if halted:
            break
    batches.close()
    if log is not None:
        log.close()
    if world > 1:
        torch.distributed.barrier()
        torch.distributed.destroy_process_group()


def _backward(model: GraspNet, batch: Batch, settings: TrainerSettings) -> dict[str, Tensor]:
    kind = batch.cloud.device.type
    with torch.autocast(kind, torch.bfloat16, enabled=settings.precision == "bfloat16"):
        prediction, _ = model(batch.cloud, batch.plan, batch.targets)
    prediction = {key: value.float() for key, value in prediction.items()}
    terms = model.representation.loss(prediction, batch.targets)
    (torch.stack(list(terms.values())).sum() / settings.shards).backward()
    return {name: value.detach() for name, value in terms.items()}


def _reduce(model: GraspNet, terms: dict[str, Tensor], halt: bool, world: int, device: torch.device) -> bool:
    """Add up gradients, losses and the wish to stop over the processes, so that all act alike."""
    if world == 1:
        return halt
    gradients = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
    flag = torch.tensor([float(halt)], device=device)
    flat = torch.cat([flag, torch.stack(list(terms.values())), *[gradient.flatten() for gradient in gradients]])
    torch.distributed.all_reduce(flat)
    terms.update(zip(terms, flat[1 : 1 + len(terms)].clone(), strict=True))
    offset = 1 + len(terms)
    for gradient in gradients:
        gradient.copy_(flat[offset : offset + gradient.numel()].view_as(gradient))
        offset += gradient.numel()
    return bool(flat[0] > 0)


def _validate_average(
    model: GraspNet, average: dict[str, Tensor], validation: Samples, samples: Samples, settings: Any, seed: int
) -> dict[str, float]:
    """Validate the averaged weights and put the trained ones back."""
    trained = {key: value.detach().clone() for key, value in model.state_dict().items()}
    device = next(model.parameters()).device
    model.load_state_dict(average)
    calibrate(model, samples, settings, seed, device)
    terms = validate(model, validation, settings, device)
    model.load_state_dict(trained)
    model.train()
    return terms


@torch.no_grad()
def _follow(average: dict[str, Tensor], model: GraspNet, decay: float) -> None:
    """Move the exponential moving average towards the weights (shorter memory in the first steps)."""
    state = model.state_dict()
    floats = [key for key, value in state.items() if value.is_floating_point()]
    torch._foreach_lerp_([average[key] for key in floats], [state[key] for key in floats], 1 - decay)


def _optimizer(model: GraspNet, settings: TrainerSettings) -> torch.optim.Optimizer:
    kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[settings.optimizer]
    fused = next(model.parameters()).device.type == "cpu"  # three times faster there
    return kind(model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=fused)


def device_of(settings: TrainerSettings) -> torch.device:
    """Return the device to train on; raises DexgraspError where there is none of that name."""
    return find_device(settings.device, "trainer.device")


def _processes(settings: TrainerSettings, device: torch.device) -> int:
    most = len(os.sched_getaffinity(0))
    if device.type == "cuda":  # cuda:1 is that one
        most = torch.cuda.device_count() if device.index is None else 1
        if settings.processes is not None and settings.processes > most:
            raise DexgraspError(
                f"trainer.processes of at most {most}, one for each GPU", str(settings.processes), "null takes them all"
            )
    wanted = settings.processes or min(most, settings.shards)
    return max(count for count in range(1, wanted + 1) if settings.shards % count == 0)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def _interrupt() -> Iterator[Any]:
    """Turn the first Ctrl-C into a wish to stop; a second one interrupts at once."""
    stop = torch.multiprocessing.get_context("spawn").Event()

    def ask(signum: int, frame: Any) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    try:
        before = signal.signal(signal.SIGINT, ask)
    except ValueError:  # not the main thread: nobody can press Ctrl-C on us
        yield stop
        return
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
