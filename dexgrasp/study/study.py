"""What a study compares, as a config says it, and the commands that it comes to."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexgrasp.errors import DexgraspError
from dexgrasp.settings import read

MADE = re.compile(r"\{made(?::(\w+))?\}")
"""In a command: the folder in which the method was made, or, {made:NAME}, an earlier one; with the same seed."""
DATA = "{data}"
"""In an extra command: the study's overrides of the dataset."""
MAKERS = ("train", "fit")
FIGURES = ("SR", "CR", "quality")
"""Published figures that a table can set beside ours: percent, percent, the publication's own quality."""


@dataclass(frozen=True)
class Method:
    """One line of the tables."""

    title: str
    judge: tuple[str, ...]
    """Overrides of `eval` that say what grasps."""
    make: tuple[str, ...] = ()
    """Command and overrides that make it; none where there is nothing to learn."""
    paper: Mapping[str, float] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Judgement:
    """One table."""

    title: str
    overrides: tuple[str, ...]
    """Of `eval`."""
    paper: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Published figures by method, where they differ from table to table."""


@dataclass(frozen=True)
class Job:
    """One command, its folder, and the folders of the jobs that it needs."""

    name: str
    words: tuple[str, ...]
    folder: Path
    needs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Study:
    """Methods and judgements; every method is judged by every judgement, for every seed."""

    title: str
    methods: dict[str, Method]
    judgements: dict[str, Judgement]
    seeds: tuple[int, ...]
    data: tuple[str, ...] = ()
    """Overrides of everything that makes a method: the dataset."""
    train: tuple[str, ...] = ()
    """Overrides of `train` alone."""
    judge: tuple[str, ...] = ()
    """Overrides of `eval`."""
    extras: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Other commands whose tables are shown, too."""
    small: float | None = None
    """Objects whose longest side is shorter are also shown apart, m."""
    note: str = ""

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> "Study":
        """Return the study of plain values; raises DexgraspError that names what is wrong in it."""
        own = {key: config[key] for key in cls.__dataclass_fields__ if key in config}
        methods, judgements = own.get("methods") or {}, own.get("judgements") or {}
        if not methods or not judgements:
            remedy = (
                "take an experiment that is a study, e.g. experiment=quick_benchmark, or write one (docs/studies.md)"
            )
            raise DexgraspError("methods and judgements to compare", "none", remedy)
        own["methods"] = {name: read(Method, each, f"methods.{name}") for name, each in methods.items()}
        own["judgements"] = {name: read(Judgement, each, f"judgements.{name}") for name, each in judgements.items()}
        own["extras"] = {name: tuple(words) for name, words in (own.get("extras") or {}).items()}
        study = read(cls, own, "the study")
        for name, method in study.methods.items():
            if method.make and method.make[0] not in MAKERS:
                raise DexgraspError(
                    f"methods.{name}.make to begin with {' or '.join(MAKERS)}", method.make[0], "mend it"
                )
            study._check(name, method)
        for where, paper in [(f"methods.{name}", each.paper) for name, each in study.methods.items()] + [
            (f"judgements.{name}.paper.{method}", figures)
            for name, each in study.judgements.items()
            for method, figures in each.paper.items()
        ]:
            if strange := set(paper) - set(FIGURES):
                raise DexgraspError(
                    f"published figures of {where}: {', '.join(FIGURES)}", ", ".join(strange), "mend it"
                )
        return study

    def _check(self, name: str, method: Method) -> None:
        """Raise DexgraspError where a method stands on something that is not made before it."""
        earlier = [each for each in list(self.methods)[: list(self.methods).index(name)] if self.methods[each].make]
        if not method.make and name in _made(method.judge, name):
            raise DexgraspError(f"methods.{name}.make, which {{made}} stands for", "none", "say how it is made")
        if name in _made(method.make, name):
            remedy = "name an earlier method: {made:NAME}"
            raise DexgraspError(f"methods.{name}.make without {{made}}, itself", "it", remedy)
        if strange := {*_made(method.make, name), *_made(method.judge, name)} - {name, *earlier}:
            remedy = f"name one that is made before {name}"
            raise DexgraspError(f"methods.{name}: {{made:NAME}} of {earlier}", ", ".join(sorted(strange)), remedy)

    def made(self, folder: Path, method: str, seed: int) -> Path:
        """Return where a method is made."""
        return folder / "made" / f"{method}-{seed}"

    def judged(self, folder: Path, judgement: str, method: str, seed: int) -> Path:
        """Return where it is judged."""
        return folder / judgement / f"{method}-{seed}"

    def jobs(self, folder: Path) -> list[Job]:
        """Return all commands in an order in which each finds what it needs."""
        jobs = []
        for seed in self.seeds:
            for name, method in self.methods.items():
                home = self.made(folder, name, seed)
                homes = {other: self.made(folder, other, seed) for other in self.methods}
                if method.make:
                    own = (*self.train, "evaluate=false") if method.make[0] == "train" else ()
                    words = (method.make[0], *self.data, *own, *_placed(method.make[1:], name, homes), f"seed={seed}")
                    needs = tuple(homes[other] for other in _made(method.make, name))
                    jobs.append(Job(f"{name}, seed {seed}: {method.make[0]}", words, home, needs))
                for rule, judgement in self.judgements.items():
                    chosen = _placed(method.judge, name, homes)
                    words = ("eval", *self.judge, *judgement.overrides, *chosen, f"seed={seed}")
                    place = self.judged(folder, rule, name, seed)
                    wanted = [*([name] if method.make else []), *_made(method.judge, name)]
                    needs = tuple(homes[other] for other in dict.fromkeys(wanted))
                    jobs.append(Job(f"{name}, seed {seed}: {rule}", words, place, needs))
        for name, words in self.extras.items():
            spread = tuple(each for word in words for each in (self.data if word == DATA else (word,)))
            jobs.append(Job(name, spread, folder / "extras" / name))
        return jobs


def _made(words: tuple[str, ...], own: str) -> Iterator[str]:
    """Yield the methods on whose folders a command of method `own` stands."""
    return (found[1] or own for word in words for found in MADE.finditer(word))


def _placed(words: tuple[str, ...], own: str, homes: Mapping[str, Path]) -> tuple[str, ...]:
    return tuple(MADE.sub(lambda found: str(homes[found[1] or own]), word) for word in words)
