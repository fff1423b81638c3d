"""Processes that make shards: joblib's, those of a Ray cluster or those of a Dask cluster; the results are the same."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import joblib

from dexgrasp.child import start_worker
from dexgrasp.errors import DexgraspError

BACKENDS = ("loky", "threading", "ray", "dask")


def check(backend: str, address: str | None, workers: int | None) -> None:
    """Raise DexgraspError for a backend that is unknown or not installed, and for settings that do not go together."""
    if backend not in BACKENDS:
        raise DexgraspError(f"dataset.backend to be one of {', '.join(BACKENDS)}", repr(backend), "set it so")
    if address is not None and backend not in ("ray", "dask"):
        remedy = "set dataset.backend to ray or dask, or leave the address out"
        raise DexgraspError("no dataset.address where all workers are on this machine", repr(address), remedy)
    if workers is not None and (type(workers) is not int or workers < 1):
        raise DexgraspError("dataset.workers a whole number of at least 1, or null", repr(workers), "set it so")
    if backend == "ray":
        _ray()
    elif backend == "dask":
        _dask()


@contextmanager
def pool(backend: str, workers: int | None = None, address: str | None = None) -> Iterator[joblib.Parallel]:
    """Open a pool of `workers` processes (None: one for each core), on this machine or on the cluster at `address`.

    It yields results as they come, in any order. Nodes of a cluster need the same Python environment and must see
    the dataset's folder under the same path; with an address, None means as many as the cluster has.
    """
    check(backend, address, workers)
    here = workers or joblib.cpu_count()
    options: dict[str, Any] = {"return_as": "generator_unordered", "batch_size": 1}
    if backend == "ray":
        with (
            _ray_cluster(address, here) as cores,
            joblib.Parallel(workers or cores, backend="dexgrasp-ray", **options) as parallel,
        ):
            yield parallel
    elif backend == "dask":
        with (
            _dask_cluster(address, here) as cores,
            joblib.parallel_config(backend="dask"),  # joblib knows this backend by its context only
            joblib.Parallel(workers or cores, **options) as parallel,
        ):
            yield parallel
    elif backend == "loky":
        yield joblib.Parallel(n_jobs=here, backend=backend, initializer=start_worker, **options)
    else:
        yield joblib.Parallel(n_jobs=here, backend=backend, **options)


@contextmanager
def _ray_cluster(address: str | None, workers: int) -> Iterator[int]:
    ray = _ray()
    ours = not ray.is_initialized()
    if ours:
        local = {} if address else {"num_cpus": workers, "include_dashboard": False}
        _reached("Ray", address, lambda: ray.init(address=address or "local", log_to_driver=False, **local))
    try:
        yield int(ray.cluster_resources()["CPU"])
    finally:
        if ours:
            ray.shutdown()


def _ray() -> Any:
    try:
        import ray
        from ray.util.joblib.ray_backend import RayBackend
    except ImportError as cause:
        raise _absent("ray") from cause

    class Backend(RayBackend):  # type: ignore[misc]
        supports_return_generator = True
        """joblib denies it to all pools of multiprocessing's kind; Ray's hands over each result when it is there."""

    joblib.register_parallel_backend("dexgrasp-ray", Backend)
    return ray


@contextmanager
def _dask_cluster(address: str | None, workers: int) -> Iterator[int]:
    distributed = _dask()
    if address:
        client = _reached("Dask", address, lambda: distributed.Client(address, timeout="10s"))
    else:
        # One thread a process: what the processes share is the disk alone.
        client = distributed.Client(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    with client:
        yield sum(client.ncores().values())


def _dask() -> Any:
    try:
        import distributed
    except ImportError as cause:
        raise _absent("dask") from cause
    return distributed


def _reached(kind: str, address: str | None, connect: Any) -> Any:
    try:
        return connect()
    except (OSError, ConnectionError, ValueError, RuntimeError, TimeoutError) as cause:
        found = f"none: {type(cause).__name__}: {' '.join(str(cause).split())[:300]}"
        remedy = "check dataset.address, and that the cluster runs and lets this user in"
        raise DexgraspError(f"a {kind} cluster at {address or 'this machine'}", found, remedy) from cause


def _absent(backend: str) -> DexgraspError:
    remedy = f"pip install 'dexgrasp[{backend}]', or set dataset.backend=loky"
    return DexgraspError(f"the package {backend} for dataset.backend={backend}", "not installed", remedy)
