"""A network as one graph that runs without dexgrasp: ONNX and torch.export. Sampling indices are among its inputs.

Finding them (farthest points, neighbours) is no work for a graph: whoever runs it makes them as `Backbone.plan` does.
"""

import json
import logging
import warnings
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

import dexgrasp
from dexgrasp.checkpoint import plain, replace_file
from dexgrasp.errors import DexgraspError
from dexgrasp.model import GraspNet
from dexgrasp.sampling import farthest_points

GRASPS = {
    "pose": "(R, 4, 4) cloud_T_base of each of R grasps, m",
    "joints": "(R, J) independent joints, rad (m where prismatic)",
    "score": "(R,) higher is better; of a network with a scorer, the probability that the grasp lifts",
    "finger": "(R,) the finger that touches at `point`, 0..F-1",
    "touching": "(R, F) fingers that close until they touch",
    "point": "(R, 3) where that finger touches, m",
}
"""What a graph of grasps returns."""
KINDS = ("grasps", "heads")
FORMATS = ("onnx", "pt2")
MOST_POINTS = 1 << 20


class Exported(nn.Module):
    """What is exported of a `GraspNet`: ``grasps``, `propose` with every index given, or the bare ``heads``."""

    def __init__(self, model: GraspNet, kind: str, names: tuple[str, ...]) -> None:
        super().__init__()
        self.model, self.kind, self.names = model.eval(), kind, names

    def forward(self, cloud: Float[Tensor, "N 6"], *indices: Int[Tensor, "..."]) -> dict[str, Tensor]:
        """Return `GRASPS`, or the representation's outputs at all seeds, of one cloud in its level frame."""
        plan = dict(zip(self.names, indices, strict=True))
        coarse = plan.pop("coarse", None)
        if self.kind == "heads":
            return self.model(cloud[None], {name: row[None] for name, row in plan.items()})[0]
        grasps = self.model.propose(cloud, plan, coarse)
        rows = torch.arange(len(grasps), device=cloud.device)
        point = grasps.contacts[rows, grasps.finger]
        values = (grasps.pose, grasps.joints, grasps.quality, grasps.finger, grasps.touching, point)
        return dict(zip(GRASPS, values, strict=True))


def indices(model: GraspNet, cloud: Float[Tensor, "N 6"], kind: str) -> dict[str, Int[Tensor, "..."]]:
    """Return all inputs of the graph but the cloud itself: the backbone's plan, int64; for a scorer, `coarse` too."""
    found = {name: value.long() for name, value in model.backbone.plan(cloud[:, :3]).items()}
    if kind == "grasps" and model.scorer is not None:
        found["coarse"] = farthest_points(cloud[:, :3], min(model.scorer.spread, len(cloud)))
    return found


@dataclass(frozen=True)
class Graph:
    """A traced network, and the names of what goes in, in order, and of what comes out."""

    program: torch.export.ExportedProgram
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    about: Mapping[str, Any]
    """What somebody needs to run it, as JSON; it is kept in its file."""

    def write(self, path: Path) -> None:
        """Write it as ONNX (``.onnx``) or for torch (``.pt2``)."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".onnx":
            replace_file(path, self._onnx())
        else:
            torch.export.save(self.program, path, extra_files={"dexgrasp.json": json.dumps(self.about)})

    def _onnx(self) -> bytes:
        try:
            import onnx
            import onnxscript  # noqa: F401  torch.onnx needs it
        except ImportError as error:
            raise DexgraspError(
                "the packages onnx and onnxscript", str(error), "pip install 'dexgrasp[onnx]'"
            ) from error
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)  # it tells hundreds of things about its rewriting
        try:
            with warnings.catch_warnings(), redirect_stdout(StringIO()):
                warnings.simplefilter("ignore")
                inputs, outputs = list(self.inputs), list(self.outputs)
                made = torch.onnx.export(
                    self.program,
                    dynamo=True,
                    verify=False,
                    verbose=False,
                    input_names=inputs,
                    output_names=outputs,
                )
        finally:
            logging.disable(before)
        assert made is not None
        proto = made.model_proto
        for part in (proto.graph.node, proto.graph.input, proto.graph.output, proto.graph.value_info):
            for each in part:
                each.ClearField("metadata_props")  # paths of this machine
        onnx.helper.set_model_props(proto, {"dexgrasp": json.dumps(self.about)})
        return bytes(proto.SerializeToString())


def trace(model: GraspNet, cloud: Float[Tensor, "N 6"], kind: str) -> Graph:
    """Return the graph, for clouds with more points than the network has seeds; `cloud` is any of these."""
    given = indices(model, cloud, kind)
    network = Exported(model, kind, tuple(given))
    spread = model.scorer.spread if "coarse" in given and model.scorer is not None else 0
    fewest = max(len(given["seeds"]), spread) + 1
    if len(cloud) < fewest:
        raise DexgraspError(f"a cloud of at least {fewest} points", str(len(cloud)), "trace with a larger one")
    shapes: Any = ({0: torch.export.Dim("points", min=fewest, max=MOST_POINTS)}, tuple({} for _ in given))
    with torch.no_grad():
        # What is kept from call to call must not be made while tracing.
        outputs = tuple(network(cloud, *given.values()))
        program = torch.export.export(network, (cloud, *given.values()), dynamic_shapes=shapes, strict=False)
    for module in program.graph_module.modules():
        for node in module.graph.nodes if isinstance(module, torch.fx.GraphModule) else ():
            node.meta.pop("stack_trace", None)  # paths of this machine
    return Graph(program, ("cloud", *given), outputs, describe(model, kind))


def describe(model: GraspNet, kind: str) -> dict[str, Any]:
    """Return what somebody needs to run the graph, as JSON; it is kept in the file too."""
    hand = model.hand
    outputs = GRASPS if kind == "grasps" else {"*": "raw outputs of the heads at the seeds, see the representation"}
    return {
        "dexgrasp": dexgrasp.__version__,
        "kind": kind,
        "input": "cloud (N, 6): position (m) and unit normal, level frame: z up, table at z = 0; then indices by name",
        "outputs": outputs,
        "dtype": str(next(model.parameters()).dtype).removeprefix("torch."),
        "points": model.points,
        "coarse": model.scorer.spread if kind == "grasps" and model.scorer is not None else 0,
        "backbone": plain(model.config["backbone"]),
        "representation": plain(model.config["repr"]),
        "hand": hand.name,
        "joint_names": list(hand.joint_names),
        "limits": hand.limits.tolist(),
        "fingers": [finger.name for finger in hand.fingers],
        "base_T_palm": hand.base_T_palm.tolist(),
    }
