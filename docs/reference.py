"""Write docs/api.md from the public docstrings: `python docs/reference.py` (needs griffelib, of the extra `dev`)."""

import sys
from collections.abc import Iterator
from pathlib import Path

import griffe

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/api.md"
SECTIONS = {
    "Predict": """
        load_model model.GraspNet.predict model.GraspNet.propose selection.Selection grasps.Grasps grasps.Reason
    """,
    "From files and cameras": """
        cloud_file.read_cloud cloud_file.Capture sensing.intrinsics.read_intrinsics sight.see sight.Sight
        prediction.predict_sight prediction.Predicted segmentation.load_segmenter segmentation.clusters
        cloud.prepare table.find_table
    """,
    "Carry out": """
        trajectory motion.TrajectorySettings motion.Trajectory load_arm arm.Arm reachable reachability.ReachSettings
        reachability.Reach arm_motion.with_arm execution.pregrasp
    """,
    "Hands": "load_hand hand.Hand hand.Finger urdf.UrdfHand",
    "Data": """
        open_dataset dataset.dataset.Dataset scene.Scene scene.View objects.Object objects.load_objects
        interchange.formats.read_grasps interchange.formats.write_grasps interchange.format.Told
        interchange.grasp_set.GraspSet
    """,
    "Judge": """
        wrench_model.WrenchModel wrench_model.Quality quality.wrenches quality.epsilon quality.reaches
        quality.volume simulation.protocol.load_protocol simulation.simulator.Simulator
        simulation.mujoco.MujocoSimulator grasps.Outcomes
    """,
    "Look": """
        viewer.open_page viewer.GraspView viewer.serve viewer.show viewer.exhibit.Exhibit viewer.sources.open_source
    """,
    "Extend": """
        representation.Representation representation.Targets backbone.Backbone planner.Planner planner.Situation
        load_representation load_backbone plugins.load_planner testing.conforms interchange.format.Format
    """,
    "Export": "model.save_model export.trace export.Graph",
    "Small things": """
        errors.DexgraspError seeds.stream geometry.inverse geometry.transform geometry.rotate geometry.pose
        geometry.look_at batch.Batch
    """,
}
"""What is promised to stay, by what one wants; names within the package."""
INTRODUCTION = """# API reference

Made from the docstrings by `python docs/reference.py`; a test keeps it so. Shapes are
[jaxtyping](https://docs.kidger.site/jaxtyping)'s: `Float[Tensor, 'N 4 4']` is a tensor of floats with three axes, of
which equal letters have equal length. Units and frames: [concepts](concepts.md). Bad input raises `DexgraspError`,
which says what was expected, what was found and what to do. What is not on this page may change without notice.
"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(page())


def page() -> str:
    """Return the text of docs/api.md."""
    package = griffe.load("dexgrasp", search_paths=[ROOT], docstring_parser="google", submodules=True)
    lines = [INTRODUCTION]
    for title, names in SECTIONS.items():
        lines += [f"## {title}", ""]
        for name in names.split():
            found = package[name if name.startswith("viewer.") or "." in name else home(name)]
            lines += [f"### `dexgrasp.{name}`", "", *described(found.final_target if found.is_alias else found), ""]
    return "\n".join(lines).rstrip() + "\n"


def home(name: str) -> str:
    """Return where a name of the package itself lives."""
    import dexgrasp

    return f"{dexgrasp._HOMES[name]}.{name}".removeprefix("dexgrasp.")


def described(found: griffe.Object) -> Iterator[str]:
    """Yield the lines of a function or class."""
    if isinstance(found, griffe.Function):
        yield from ("```py", signature(found), "```", "", *documented(found))
        return
    bases = ", ".join(str(base) for base in found.bases)
    yield from ("```py", f"class {found.name}" + (f"({bases})" if bases else ""))
    start = found.all_members.get("__init__")
    if isinstance(start, griffe.Function) and len(start.parameters) > 1:
        yield signature(start, found.name)
    yield from ("```", "", *documented(found))
    members = [each for each in found.all_members.values() if each.name[0] != "_" and each.docstring]
    for each in members:
        text = " ".join(each.docstring.value.split("\n\n")[0].split())
        if isinstance(each, griffe.Function) and "property" not in each.labels:
            yield f"- `{signature(each)}`: {text}"
        elif isinstance(each, griffe.Attribute | griffe.Function):
            kind = getattr(each, "annotation", None)
            yield f"- `{each.name}`" + (f" (`{kind}`)" if kind else "") + f": {text}"


def signature(function: griffe.Function, name: str = "") -> str:
    """Return a function's signature as it is written, on one line where it fits."""
    parts: list[str] = []
    for parameter in function.parameters:
        if parameter.name in ("self", "cls"):
            continue
        star = {"variadic positional": "*", "variadic keyword": "**"}.get(parameter.kind.value, "")
        if parameter.kind is griffe.ParameterKind.keyword_only and not any(part.startswith("*") for part in parts):
            parts.append("*")
        text = f"{star}{parameter.name}" + (f": {parameter.annotation}" if parameter.annotation else "")
        parts.append(text + (f" = {parameter.default}" if parameter.default is not None and not star else ""))
    name = name or function.name
    ends = f" -> {function.returns}" if function.returns and name == function.name else ""
    return f"{name}({', '.join(parts)}){ends}"


def documented(found: griffe.Object) -> Iterator[str]:
    """Yield a docstring: text, then arguments and errors as lists."""
    for section in found.docstring.parsed if found.docstring else ():
        if section.kind is griffe.DocstringSectionKind.text:
            yield from (section.value, "")
        elif section.kind is griffe.DocstringSectionKind.parameters:
            yield from (f"- `{each.name}`: {' '.join(each.description.split())}" for each in section.value)
            yield ""
        elif section.kind is griffe.DocstringSectionKind.raises:
            yield from (f"Raises `{each.annotation}`: {' '.join(each.description.split())}" for each in section.value)
            yield ""


if __name__ == "__main__":
    sys.exit(main())
