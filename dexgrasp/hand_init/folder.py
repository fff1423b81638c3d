"""A hand's plugin folder: a whole project of YAML, URDF, meshes and README, each guess in its place."""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexgrasp.errors import DexgraspError, room
from dexgrasp.hand_init.anatomy import Anatomy
from dexgrasp.hand_init.collision import Fit
from dexgrasp.hand_init.fingers import FingerGuess
from dexgrasp.hand_init.fingertip import Fingertip
from dexgrasp.hand_init.guess import Guess, Guesses
from dexgrasp.hand_init.palm import Palm
from dexgrasp.hand_init.urdf_text import write_urdf

WIDTH = 118
PROJECT = """[build-system]
requires = ["hatchling>=1.26"]
build-backend = "hatchling.build"

[project]
name = "dexgrasp-{dashed}"
version = "0.1.0"
description = "The hand {name} for dexgrasp: URDF, geometry and a few lines of YAML"
readme = "README.md"
requires-python = ">=3.11,<3.14"
dependencies = ["dexgrasp"]

[project.entry-points."dexgrasp.hands"]
{name} = "dexgrasp_{name}"

[tool.hatch.build.targets.wheel]
packages = ["dexgrasp_{name}"]
"""
README = """# {name}

`hand={name}`: {count} fingers ({fingers}), {joints} independent joints.
Written by `python -m dexgrasp hand init {file}`.

    python -m dexgrasp hand check {name}/dexgrasp_{name}/conf/hand/{name}.yaml
    python -m dexgrasp dataset --config-dir {name}/dexgrasp_{name}/conf hand={name}
    pip install -e {name}                # from then on it is `hand={name}` everywhere

## The model and its source

Source: {file}. Licence: UNKNOWN; look it up before you pass this folder on, write it here and into pyproject.toml.
`dexgrasp_{name}/urdf/{name}.urdf` is the hand alone, in metres, couplings resolved;
`meshes/*.stl` is what one sees, and the convex parts that collide.

## What was guessed

{unsure}

| about | how sure | what was taken, and why |
|---|---|---|
{guesses}

## Collision shapes

95 % of the visible surface lies within `outside` of the convex parts, and 95 % of theirs within `beyond` of it.

| link | parts | source | outside, mm | beyond, mm |
|---|---|---|---|---|
{fits}
"""


@dataclass(frozen=True)
class Found:
    """What is written of a hand."""

    anatomy: Anatomy
    fingers: list[FingerGuess]
    tips: list[Fingertip]
    palm: Palm
    shared: Sequence[str]
    allowed: Sequence[tuple[str, str]]
    fits: Sequence[Fit]


def write_folder(target: Path, name: str, found: Found, guesses: Guesses) -> Path:
    """Write the folder in one step; return the YAML's path. Raises DexgraspError where the folder is there already."""
    refuse(target)
    model, fingers = found.anatomy.model, found.fingers
    model.name = name
    with room("the hand's folder", target.parent):
        target.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        try:
            package = draft / f"dexgrasp_{name}"
            write_urdf(model, package)
            (package / "conf" / "hand").mkdir(parents=True)
            names = ", ".join(finger.name for finger in fingers)
            (package / "__init__.py").write_text(f'"""{name}: {len(fingers)} fingers ({names})."""\n', encoding="utf-8")
            text = yaml_text(name, found, guesses)
            (package / "conf" / "hand" / f"{name}.yaml").write_text(text, encoding="utf-8")
            (draft / "pyproject.toml").write_text(
                PROJECT.format(name=name, dashed=name.replace("_", "-")), encoding="utf-8"
            )
            unsure = "\n".join(f"- **{g.topic}**: {g.text}" for g in guesses.unsure)
            readme = README.format(
                name=name,
                count=len(fingers),
                fingers=names,
                joints=len(model.free),
                file=model.path.name,
                unsure=f"Look at these:\n\n{unsure}" if unsure else "Nothing of it is unsure.",
                guesses="\n".join(f"| {g.topic} | {g.confidence} | {g.text} |" for g in guesses.made),
                fits="\n".join(
                    f"| {f.link} | {f.parts} | {f.source} | {f.outside * 1e3:.1f} | {f.beyond * 1e3:.1f} |"
                    for f in found.fits
                ),
            )
            (draft / "README.md").write_text(readme, encoding="utf-8")
            draft.chmod(0o755)
            refuse(target)
            draft.rename(target)
        except BaseException:
            shutil.rmtree(draft, ignore_errors=True)
            raise
    return target / f"dexgrasp_{name}" / "conf" / "hand" / f"{name}.yaml"


def refuse(target: Path) -> None:
    """Raise DexgraspError where there is something at the folder's place."""
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise DexgraspError("a new folder for the hand", f"{target} is there already", "remove it, or say out=<folder>")


def yaml_text(name: str, found: Found, guesses: Guesses) -> str:
    """Return the hand's YAML; guesses stand as comments above what they led to."""
    source, palm = found.anatomy.model.path.name, found.palm
    lines = _comment(
        f"{name}, written by `python -m dexgrasp hand init {source}`. What the model does not say outright was "
        "guessed: `sure` where two things agree, `likely` where one says so, `UNSURE` where you should look. "
        f"Units m and rad; frames are the URDF's. `python -m dexgrasp hand check` tries it."
    )
    told = {"palm", "shared", "allowed_contacts"} | {
        guess.topic for guess in guesses.made if guess.topic.startswith("fingers.")
    }
    rest = [guess for guess in guesses.made if guess.topic not in told]
    lines += [f"name: {name}", f"urdf: ../../urdf/{name}.urdf  # relative to this file"]
    lines += [line for guess in rest for line in _told(guess)]
    lines += [line for guess in guesses.about("palm") for line in _told(guess)]
    lines.append(f"palm: {{origin: {_list(palm.origin, 4)}, approach: {_list(palm.approach, 6)}}}")
    lines += [line for guess in guesses.about("shared") for line in _told(guess)]
    if found.shared:
        lines.append(f"shared: [{', '.join(map(_word, found.shared))}]")
    lines += [line for guess in guesses.about("allowed_contacts") for line in _told(guess)]
    if found.allowed:
        lines.append(f"allowed_contacts: [{', '.join(f'[{_word(a)}, {_word(b)}]' for a, b in found.allowed)}]")
    lines.append("fingers:")
    for finger, tip in zip(found.fingers, found.tips, strict=True):
        topics = (f"fingers.{finger.link}", f"fingers.{finger.name}.closing", f"fingers.{finger.name}.tip")
        lines += [f"  {line}" for topic in topics for guess in guesses.about(topic) for line in _told(guess)]
        lines += [f"  - name: {_word(finger.name)}", f"    link: {_word(finger.link)}"]
        closing = ", ".join(f"{_word(joint)}: {rate:g}" for joint, rate in finger.closing.items())
        lines.append(f"    closing: {{{closing}}}  # joint: rate; 1 is towards its upper limit")
        numbers = {"tip_radius": f"{tip.radius:.6g}", "tip_center": _list(tip.center, 12)}
        numbers |= {"outer_joint": _list(tip.joint, 12), "closing_axis": _list(tip.axis, 12)}
        lines += [f"    {key}: {numbers[key]}" for key in numbers if key in tip.told]
        lines.append("    # Link coordinates; found from mesh and joint again unless told here:")
        lines += [f"    # {key}: {value}" for key, value in numbers.items() if key not in tip.told]
    return "\n".join(lines) + "\n"


def _told(guess: Guess) -> list[str]:
    return _comment(f"[{guess.confidence}] {guess.topic}: {guess.text}")


def _comment(text: str) -> list[str]:
    lines, line = [], "#"
    for word in text.split():
        if len(line) + len(word) > WIDTH - 4:
            lines.append(line)
            line = "#  "
        line += f" {word}"
    return [*lines, line]


def _list(vector: np.ndarray, digits: int) -> str:
    return f"[{', '.join(f'{round(float(v), digits) + 0.0:.12g}' for v in vector)}]"


def _word(name: str) -> str:
    """Return a name as YAML takes it for text."""
    plain = name.replace("_", "").replace("-", "").isalnum() and not name[0].isdigit() and not name.startswith("-")
    return (
        name
        if plain and name.lower() not in ("yes", "no", "on", "off", "true", "false", "null", "y", "n")
        else f'"{name}"'
    )
