"""The entry points that are installed: listed, found and imported by name, nothing before it is asked for."""

import ast
import difflib
import inspect
from dataclasses import dataclass
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points
from importlib.util import find_spec
from pathlib import Path

from dexgrasp.errors import DexgraspError

GROUPS = {
    "hand": "dexgrasp.hands",
    "repr": "dexgrasp.representations",
    "backbone": "dexgrasp.backbones",
    "planner": "dexgrasp.planners",
}
"""Entry-point group of each kind; the kind is also the name of the config group."""


@dataclass(frozen=True)
class Plugin:
    """What is known of a plugin without importing it."""

    kind: str
    name: str
    distribution: str
    summary: str


def installed(kind: str | None = None) -> list[Plugin]:
    """Return all plugins, of one kind or of all, sorted; nothing is imported."""
    kinds = [kind] if kind else list(GROUPS)
    return [
        Plugin(kind, entry.name, _distribution(entry), _summary(entry))
        for kind in kinds
        for entry in sorted(entries(kind), key=lambda entry: entry.name)
    ]


def names(kind: str) -> list[str]:
    """Return the names of the installed plugins of one kind, sorted."""
    return sorted({entry.name for entry in entries(kind)})


def find(kind: str, name: str) -> EntryPoint:
    """Return the one entry point of that name; `DexgraspError` where there is none or more than one."""
    found = named(kind, name)
    if not found:
        raise unknown(kind, name, names(kind))
    if len(found) > 1:
        owners = " and ".join(sorted(f"{_distribution(entry)} ({entry.value})" for entry in found))
        raise DexgraspError(
            f"one distribution that provides the {kind} {name!r}",
            f"{len(found)}: {owners}",
            "uninstall all but one, or rename the entry point in the pyproject.toml of yours",
        )
    return found[0]


def load_class(kind: str, name: str) -> type:
    """Import the class behind an entry point and check its type."""
    entry = find(kind, name)
    plugin = f"the {kind} {name!r} ({entry.value}) of distribution {_distribution(entry)}"
    try:
        loaded = entry.load()
    except Exception as error:
        raise DexgraspError(
            f"{plugin} to import",
            f"{type(error).__name__}: {error}",
            "repair or uninstall that distribution; all other plugins keep working",
        ) from error
    base = _base(kind)
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        raise DexgraspError(
            f"{plugin} to be a subclass of {base.__module__}.{base.__name__}",
            f"{loaded!r}",
            f"derive it from {base.__name__}, or move the entry point to the group of its kind: {GROUPS}",
        )
    if inspect.isabstract(loaded):
        missing = ", ".join(sorted(getattr(loaded, "__abstractmethods__", ())))
        raise DexgraspError(f"{plugin} to be complete", f"abstract methods: {missing}", "define them in the class")
    return loaded


def unknown(kind: str, name: str, known: list[str]) -> DexgraspError:
    """Return the error for a name that is not there: did you mean, and what is installed."""
    close = difflib.get_close_matches(str(name), known, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    listed = ", ".join(known) or "none"
    return DexgraspError(
        f"an installed {kind}: {listed}", repr(name), f"{hint}`python -m dexgrasp plugins` lists what is installed"
    )


def conf_folders() -> list[tuple[str, Path]]:
    """Return (top-level package, its config folder) of every plugin that has one, ours first; nothing is imported."""
    order = {(_distribution(entry) != "dexgrasp", top_package(entry)) for kind in GROUPS for entry in entries(kind)}
    packages = dict.fromkeys(package for _, package in sorted(order))
    return [(package, folder) for package in packages if (folder := conf_folder(package)) is not None]


def conf_folder(package: str) -> Path | None:
    """Return the first that exists of ``package/conf`` and ``package/../conf`` (a source tree)."""
    home = package_folder(package)
    if home is None:
        return None
    return next((folder for folder in (home / "conf", home.parent / "conf") if folder.is_dir()), None)


def package_folder(package: str) -> Path | None:
    """Return the folder of a package, dotted or not, without importing anything; None where there is none."""
    top, *rest = package.split(".")
    try:
        spec = find_spec(top)
    except (ImportError, ValueError):
        return None
    for location in (spec.submodule_search_locations or ()) if spec else ():
        folder = Path(location).joinpath(*rest)
        if folder.is_dir():
            return folder.resolve()
    return None


def installed_file(name: str, path: str) -> Path | None:
    """Return the file of an installed distribution whose path ends with `path`; None where there is none."""
    try:
        listed = distribution(name).files or []
    except PackageNotFoundError:
        return None
    wanted = Path(path).parts
    found = next((file for file in listed if file.parts[-len(wanted) :] == wanted), None)
    return Path(str(found.locate())).resolve() if found else None


def entries(kind: str) -> list[EntryPoint]:
    """Return the entry points of one kind; one that is found twice on the path counts once."""
    if kind not in GROUPS:
        raise DexgraspError(f"a kind of plugin: {', '.join(GROUPS)}", repr(kind), "use one of them")
    unique = {(entry.name, entry.value, _distribution(entry)): entry for entry in entry_points(group=GROUPS[kind])}
    return list(unique.values())


def named(kind: str, name: str) -> list[EntryPoint]:
    """Return the entry points of that name: none, one, or one of each distribution that has it."""
    return [entry for entry in entries(kind) if entry.name == name]


def _distribution(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist else "(unknown)"


def top_package(entry: EntryPoint) -> str:
    """Return the top-level package of an entry point's value."""
    return entry.module.split(".")[0]


def _base(kind: str) -> type:
    if kind == "hand":
        from dexgrasp.hand import Hand

        return Hand
    if kind == "repr":
        from dexgrasp.representation import Representation

        return Representation
    if kind == "planner":
        from dexgrasp.planner import Planner

        return Planner
    from dexgrasp.backbone import Backbone

    return Backbone


def _summary(entry: EntryPoint) -> str:
    """First line of the docstring of the class or else the module, read without importing."""
    home = package_folder(top_package(entry))
    if home is None:
        return f"broken: package {top_package(entry)} is not there"
    stem = home.joinpath(*entry.module.split(".")[1:])
    source = next((path for path in (stem / "__init__.py", stem.with_suffix(".py")) if path.is_file()), None)
    if source is None:
        return f"broken: module {entry.module} is not there"
    try:
        tree = ast.parse(source.read_text(encoding="utf-8"))
    except (SyntaxError, UnicodeDecodeError) as error:
        return f"broken: {error}"
    nodes: list[ast.ClassDef | ast.Module] = [tree]
    nodes[:0] = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == entry.attr]
    return next((text for node in nodes if (text := ast.get_docstring(node))), "").split("\n")[0]
