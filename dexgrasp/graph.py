"""A prediction as one CUDA graph: what is launched one by one from Python otherwise is launched at once.

A network is small, and most of the time of a prediction on a GPU goes by with launching. A graph repeats what was
launched once, on the same memory: clouds of one size, written where the first lay. All constants must lie on the GPU
before: what eager code copies there from the CPU, call by call (a hand's kinematics, numbers in lists), is recorded
and taken from the record while the graph is captured.
"""

import copy
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from dexgrasp.grasps import Grasps
from dexgrasp.heads import Layers, folded

if TYPE_CHECKING:
    from dexgrasp.model import GraspNet

log = logging.getLogger(__name__)
WARM = 3
"""Runs before the capture: libraries start, kernels are compiled, constants are recorded."""


class Constants:
    """What a function copies from the CPU to a device, recorded once; later it is taken from the record.

    Whatever a function of tensors on a device takes from the CPU is a constant: it does not depend on its input.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.kept: list[Tensor] = []

    @contextmanager
    def record(self) -> Iterator[None]:
        """Keep what is copied; RuntimeError where somebody writes to it, who would find it written to next time."""
        self.kept.clear()
        versions: list[int] = []

        def keep(make: Callable[[], Tensor]) -> Tensor:
            before, made = len(self.kept), make()
            self.kept[before:], versions[before:] = [made], [made._version]  # and nothing that `make` has made
            return made

        with _Made(self.device, keep), _Copied(self.device, keep):
            yield
        if versions != [tensor._version for tensor in self.kept]:
            raise RuntimeError("a constant is changed in place")

    @contextmanager
    def replay(self) -> Iterator[None]:
        """Copy nothing; RuntimeError where other things are asked for than were recorded."""
        rest = list(reversed(self.kept))

        def serve(make: Callable[[], Tensor]) -> Tensor:
            if not rest:
                raise RuntimeError("more constants are asked for than were recorded")
            return rest.pop()

        with _Made(self.device, serve), _Copied(self.device, serve):
            yield
        if rest:
            raise RuntimeError("fewer constants are asked for than were recorded")


class _Made(TorchFunctionMode):
    """Tensors made of numbers."""

    def __init__(self, device: torch.device, serve: Callable[[Callable[[], Tensor]], Tensor]) -> None:
        super().__init__()
        self.there, self.serve = device.type, serve

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor):
            target = torch.device(kwargs.get("device") or "cpu")
        elif func is Tensor.new_tensor:
            target = torch.device(kwargs.get("device") or args[0].device)
        else:
            return func(*args, **kwargs)
        return self.serve(lambda: func(*args, **kwargs)) if target.type == self.there else func(*args, **kwargs)


class _Copied(TorchDispatchMode):
    """Tensors copied from the CPU."""

    def __init__(self, device: torch.device, serve: Callable[[Callable[[], Tensor]], Tensor]) -> None:
        super().__init__()
        self.there, self.serve = device.type, serve

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        target = kwargs.get("device")
        copied = func is torch.ops.aten._to_copy.default and args[0].device.type == "cpu" and target is not None
        if copied and torch.device(target).type == self.there:
            return self.serve(lambda: func(*args, **kwargs))
        return func(*args, **kwargs)


@torch.no_grad()
def joined(model: "GraspNet") -> "GraspNet":
    """Return a copy for prediction whose linear layers hold the batch norms behind them: fewer launches."""
    model = copy.deepcopy(model).eval()
    model.captured = None
    for layers in [module for module in model.modules() if isinstance(module, Layers)]:
        for place, (layer, norm) in enumerate(pairwise(layers)):
            if isinstance(layer, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
                weight, bias = folded(layer, norm)
                whole = nn.Linear(layer.in_features, layer.out_features, device=weight.device)
                whole.load_state_dict({"weight": weight, "bias": bias})
                layers[place], layers[place + 1] = whole, nn.Identity()
    return model


class Captured:
    """`GraspNet.propose` for clouds of `model.points` points, captured at the first one with the weights of then.

    Others, and where a graph cannot be captured, are served without, and the log says so once: the same grasps, slower.
    """

    def __init__(self, model: "GraspNet") -> None:
        self.model, self.points = model, model.points
        self.eager: str | None = None
        """Why there is no graph."""
        self._said = False
        self._graph: Any = None
        self._cloud: Tensor
        self._network: GraspNet
        self._grasps: Grasps
        self._constants: Constants

    @torch.no_grad()
    def __call__(self, cloud: Float[Tensor, "N 6"]) -> Grasps:
        """Return grasps at the seeds of a cloud (level frame), see `GraspNet.propose`."""
        if self._graph is None and self.eager is None and len(cloud) == self.points:
            with torch.cuda.device(cloud.device) if cloud.is_cuda else nullcontext():
                self._capture(cloud)
        if self.eager is None and len(cloud) == self.points:
            self._cloud.copy_(cloud)
            self._graph.replay()
            return Grasps(**{name: value.clone() for name, value in self._grasps.tensors().items()})
        if not self._said:
            self._said = True
            log.warning("no CUDA graph: %s", self.eager or f"{len(cloud)} points, captured for {self.points}")
        return self.model.launch(cloud)

    def _capture(self, cloud: Float[Tensor, "N 6"]) -> None:
        if not cloud.is_cuda:
            self.eager = "the network is not on a CUDA device"
            return
        try:
            self._cloud, self._constants = cloud.clone(), Constants(cloud.device)
            beside = torch.cuda.Stream(cloud.device)
            beside.wait_stream(torch.cuda.current_stream(cloud.device))
            with torch.cuda.stream(beside):
                network = joined(self.model)
                for _ in range(WARM):
                    with self._constants.record():
                        network.propose(self._cloud)
            torch.cuda.current_stream(cloud.device).wait_stream(beside)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph), self._constants.replay():
                self._grasps = network.propose(self._cloud)
            self._network, self._graph = network, graph  # whose weights the graph reads
        except RuntimeError as error:
            torch.cuda.synchronize(cloud.device)
            self.eager = f"capture failed: {error}"
