"""What a study compares, as a config says it, and the commands that it comes to."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexgrasp.errors import DexgraspError
from dexgrasp.settings import read

MADE = "{made}"
"""In a command: the folder in which the method was made, with the same seed."""
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
            if not method.make and any(MADE in word for word in method.judge):
                raise DexgraspError(f"methods.{name}.make, which {MADE} stands for", "none", "say how it is made")
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
                if method.make:
                    own = (*self.train, "evaluate=false") if method.make[0] == "train" else ()
                    words = (method.make[0], *self.data, *own, *method.make[1:], f"seed={seed}")
                    jobs.append(Job(f"{name}, seed {seed}: {method.make[0]}", words, home))
                for rule, judgement in self.judgements.items():
                    chosen = tuple(word.replace(MADE, str(home)) for word in method.judge)
                    words = ("eval", *self.judge, *judgement.overrides, *chosen, f"seed={seed}")
                    place = self.judged(folder, rule, name, seed)
                    jobs.append(Job(f"{name}, seed {seed}: {rule}", words, place, (home,) if method.make else ()))
        for name, words in self.extras.items():
            spread = tuple(each for word in words for each in (self.data if word == DATA else (word,)))
            jobs.append(Job(name, spread, folder / "extras" / name))
        return jobs
