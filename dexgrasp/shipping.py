"""Weights that lie in the package: a checkpoint under a name, and a model card that says what it is and how good."""

import json
import re
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import dexgrasp
from dexgrasp.checkpoint import FILE, WEIGHTS, read_tensors, replace_file, write_tensors
from dexgrasp.errors import DexgraspError
from dexgrasp.export import Exported
from dexgrasp.export_check import Difference, compare, level_views
from dexgrasp.model import GraspNet, load_model
from dexgrasp.origins import origins
from dexgrasp.report import rows

LIMIT = 20_000_000
"""Bytes that all weights of the package may have together."""
MOVED = 0.005
"""How far a grasp may move in half precision: m, rad, and of its score."""
BEGAN = "What it began with"
"""How the part of a card begins that tells of weights shipped before."""
KEPT = 0.95
"""Share of the grasps that must stay within that."""


def ship(
    path: Path,
    name: str,
    folder: Path = WEIGHTS,
    half: bool = False,
    results: Sequence[Path] = (),
    views: int = 10,
    seed: int = 0,
) -> Path:
    """Write a training's checkpoint as ``<name>.safetensors`` with its card ``<name>.md``; return the card's path.

    `path` is the checkpoint; the config, command and figures of the card are read from the files of its training that
    lie beside it, further figures from the evaluations in `results`. With `half`, matrices are stored in half
    precision; vectors (biases, the norms' statistics), where it would cost range, are not.

    Raises DexgraspError for a bad name, no network, more than `LIMIT` bytes in all, or where half precision moves
    grasps on `views` views.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise DexgraspError("a name of small letters, digits and _", repr(name), "set ship=NAME")
    tensors, notes = read_tensors(path)
    if notes.get("kind") != "model":
        raise DexgraspError("the weights of a finished training", f"{path} of another kind", f"give its {FILE}")
    model = load_model(path)
    found = None
    if half:
        tensors = {key: value.half() if _matrix(value) else value for key, value in tensors.items()}
        found = _halved(model, tensors, notes, views, seed)
    target = folder / f"{name}.safetensors"
    size = sum(value.numel() * value.element_size() for value in tensors.values())
    others = sum(file.stat().st_size for file in folder.glob("*.safetensors") if file != target)
    if size + others > LIMIT:
        told = f"{size / 1e6:.1f} MB beside {others / 1e6:.1f} MB"
        raise DexgraspError(f"at most {LIMIT / 1e6:.0f} MB of shipped weights", told, "half=true, or ship fewer")
    source = commit()  # before what is written counts as a change
    write_tensors(target, tensors, {key: value for key, value in notes.items() if key != "format"})
    lines = _card(name, target, path.parent, model, notes, found, results, source)
    card = target.with_suffix(".md")
    replace_file(card, ("\n".join(lines) + "\n").encode())
    return card


def _matrix(value: Tensor) -> bool:
    return value.dtype == torch.float32 and value.dim() >= 2


def _halved(
    model: GraspNet, tensors: Mapping[str, Tensor], notes: Mapping[str, Any], count: int, seed: int
) -> Difference:
    """Return how far grasps move in half precision; refuse it where they do."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILE
        write_tensors(path, tensors, {key: value for key, value in notes.items() if key != "format"})
        coarse = load_model(path)

    def run(given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        values = {key: torch.from_numpy(value) for key, value in given.items()}
        cloud = values.pop("cloud")
        with torch.no_grad():
            told = Exported(coarse, "grasps", tuple(values))(cloud, *values.values())
        return {key: value.numpy() for key, value in told.items()}

    found = compare(model, "grasps", run, level_views(model, count, seed), MOVED)
    if found.beyond > (1 - KEPT) * found.rows:
        told = f"{found.beyond} of {found.rows} move by more than {MOVED} (m, rad, of the score)"
        raise DexgraspError("grasps that half precision leaves where they are", told, "half=false")
    return found


def _card(
    name: str,
    target: Path,
    run: Path,
    model: GraspNet,
    notes: Mapping[str, Any],
    half: Difference | None,
    results: Sequence[Path],
    source: str,
) -> Iterator[str]:
    config = OmegaConf.load(run / "config.yaml") if (run / "config.yaml").is_file() else None
    own = _json(run / "results.json") if (run / "results.json").is_file() else {}
    parts = {kind: part["name"] for kind, part in notes["config"].items()}
    before = _before(config)
    yield f"# {name}"
    yield ""
    yield (
        f"Grasps of the hand `{parts['hand']}` from one view: representation `{parts['repr']}`, backbone "
        f"`{parts['backbone']}`, {sum(p.numel() for p in model.parameters()):,} parameters"
        f"{'' if model.scorer is None else ' with a scorer'}, {target.stat().st_size / 1e6:.1f} MB. "
        f'`dexgrasp.load_model("{name}")`.'
    )
    if half is not None:
        yield ""
        yield (
            f"Matrices are stored in half precision: on {half.views} views {1 - half.beyond / half.rows:.2%} of "
            f"{half.rows:,} grasps stay within {MOVED:g} m, rad and of their score."
        )
    yield from ("", "## How it was made", "")
    yield f"- dexgrasp {dexgrasp.__version__}, shipped from commit {source}; torch {torch.__version__}"
    yield from _told(run, notes)
    yield from before["How it was made"]
    yield from ("", "## Data and licences", "")
    yield from _data(config) if isinstance(config, DictConfig) else ["Not known: no config lies beside the weights."]
    yield from before["Data and licences"]
    yield from ("", "## Figures", "")
    yield from _figures(own, results)
    if config is not None:
        # Where a folder lay on the machine of the training is nobody's business.
        told = re.sub(r"(?m)(: )/\S*/([^/\s]+)$", r"\1.../\2", OmegaConf.to_yaml(config).rstrip())
        yield from ("", "## Config", "", "```yaml", told, "```")


def _told(run: Path, notes: Mapping[str, Any]) -> Iterator[str]:
    """Yield seed, steps and command of a training."""
    facts = notes.get("facts", {})
    yield f"- seed {facts.get('seed', 'not known')}, {facts.get('steps', 'an unknown number of')} steps"
    overrides = run / ".hydra" / "overrides.yaml"
    if overrides.is_file():
        words = [re.sub(r"=/[^\s,\]]+", "=DIR", str(word)) for word in OmegaConf.load(overrides)]
        yield f"- `python -m dexgrasp train {' '.join(words)}`".rstrip("` ") + "`"


def _before(config: Any) -> dict[str, list[str]]:
    """Return how the weights were made that a training began with: by their card, or by the files beside them."""
    told: dict[str, list[str]] = {"How it was made": [], "Data and licences": []}
    start = None if config is None else config.get("init_from")
    if start is None:
        return told
    # Of a scorer that was taught anew nothing is left: the network alone counts, and what that began with.
    alone = OmegaConf.select(config, "trainer.steps") == 0 and bool(OmegaConf.select(config, "scorer.anew"))
    card, run = WEIGHTS / f"{start}.md", Path(start)
    if not card.is_file():
        told["How it was made"] = ["- it began with another training, whose card is its own"]
        if (run / FILE).is_file() and (run / "config.yaml").is_file():
            began = ["", f"{BEGAN}, {'the network of ' if alone else ''}another training:", ""]
            its = OmegaConf.load(run / "config.yaml")
            data = _data(its) if isinstance(its, DictConfig) else []
            told = {
                "How it was made": [*began, *_told(run, read_tensors(run / FILE)[1])],
                "Data and licences": [*began, *data],
            }
        return told
    for section in card.read_text().split("\n## ")[1:]:
        title, *lines = section.splitlines()
        if title in told:
            lines = [each for each in lines if each]
            earlier = [row for row, each in enumerate(lines) if each.startswith(BEGAN)]
            lines = lines[earlier[-1] + 1 :] if alone and earlier else lines
            told[title] = ["", f"{BEGAN}, {'the network of ' if alone else ''}`{start}` as shipped before:", "", *lines]
    return told


def _data(config: DictConfig) -> Iterator[str]:
    """Yield from what objects the network learnt."""
    yield "Grasps, scenes and views are computed by this program; nothing was recorded."
    objects = config.dataset.objects
    for each in objects.sets.values() if objects.kind == "several" else [objects]:
        yield from _set(each)


def _set(objects: Mapping[str, Any]) -> Iterator[str]:
    if objects["kind"] == "procedural":
        yield f"Objects: shapes that this program makes (`{objects['split']}`, seed {objects['seed']}), Apache-2.0."
        return
    told = [licence for file, (_, licence) in origins(Path(str(objects["path"]))).items() if _taken(file.stem, objects)]
    counted = Counter(licence or "not stated" for licence in told)
    scale = objects.get("scale") or 1
    yield (
        f"Objects: {len(told) or 'an unknown number of'} meshes of the folder `{Path(str(objects['path'])).name}`"
        f"{'' if scale == 1 else f', scaled by {scale:g}'}. "
    )
    yield "; ".join(f"{count}: {licence}" for licence, count in counted.most_common()) or "Licences: not stated."


def _taken(name: str, objects: Mapping[str, Any]) -> bool:
    """Tell whether `include` and `exclude` leave an object in the set."""
    globs = {key: [objects[key]] if isinstance(objects[key], str) else objects[key] for key in ("include", "exclude")}
    return any(fnmatch(name, glob) for glob in globs["include"]) and not any(
        fnmatch(name, glob) for glob in globs["exclude"]
    )


def _figures(own: Mapping[str, Any], results: Sequence[Path]) -> Iterator[str]:
    """Yield a table of every evaluation."""
    evaluations = [own["evaluation"]] if "evaluation" in own else []
    evaluations += [_json(path / "results.json" if path.is_dir() else path) for path in results]
    if not evaluations:
        yield "Not evaluated."
    for each in evaluations:
        if "summary" not in each:
            raise DexgraspError("results of an evaluation", str(each.get("schema")), "give folders of `eval`")
        counts, objects = each["scenes"]["counts"], each["objects"]
        yield (
            f"{each['protocol']}, seed {each['seed']}: {each['summary']['scenes']} scenes of {counts} objects "
            f"({objects['kind']} {objects.get('split') or Path(str(objects.get('path', ''))).name})"
        )
        yield from ("", "| what | value, 95 % | of |", "|---|---|---|")
        yield from (f"| {what} | {value} | {total} |" for what, value, total in rows(each))
        yield ""
    if "scorer" in own:
        yield f"Area under the scorer's ROC on validation views: {own['scorer']['area']:.3f}."


def commit() -> str:
    """Return the commit of the source tree that runs, with -dirty where it was changed."""
    folder = Path(__file__).parent
    words = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True, timeout=30).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "not known"


def _json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError) as error:
        raise DexgraspError(f"results in {path}", f"{type(error).__name__}: {error}", "check the path") from error
