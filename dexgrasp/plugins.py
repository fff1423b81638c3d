"""Hands, representations and backbones: from an entry point's name to an object.

A plugin is an entry point of one of three groups. Its value names a class, or for a hand a package that holds only a
YAML and a URDF. Nothing of a plugin is imported before it is asked for by name; its YAML,
``<package>/conf/<kind>/<name>.yaml``, has the key `name`, which picks the entry point, and constructor arguments.
"""

import ast
import difflib
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexgrasp.errors import DexgraspError

if TYPE_CHECKING:
    from dexgrasp.backbone import Backbone
    from dexgrasp.hand import Hand
    from dexgrasp.representation import Representation

GROUPS = {"hand": "dexgrasp.hands", "repr": "dexgrasp.representations", "backbone": "dexgrasp.backbones"}
"""Entry-point group of each kind; the kind is also the name of the config group."""


def load_hand(name: str, **overrides: Any) -> "Hand":
    """Return the installed hand `name`, or the hand of the YAML file at path `name`.

    `overrides` replace keys of its YAML. Raises `DexgraspError` for an unknown or broken hand.
    """
    return build_hand(_options("hand", name, overrides))


def load_representation(name: str, hand: "Hand", channels: int = 128, **options: Any) -> "Representation":
    """Return the representation `name` of `hand`, with heads for point features of size `channels`."""
    return build_representation(_options("repr", name, options), hand, channels)


def load_backbone(name: str, **options: Any) -> "Backbone":
    """Return the backbone `name`; `options` replace keys of its YAML."""
    return build_backbone(_options("backbone", name, options))


def build_hand(config: Mapping[str, Any]) -> "Hand":
    """Return the hand of a composed config: `name` picks the entry point, other keys are constructor arguments.

    A name that is not installed is fine where `urdf` and `fingers` are given: a hand in a plain folder.
    """
    from dexgrasp.hand import Hand
    from dexgrasp.urdf import UrdfHand

    options = _resolved("hand", config)
    plain = {"urdf", "fingers"} <= options.keys() and not _named("hand", options["name"])
    hand_class = UrdfHand if plain or not find("hand", options["name"]).attr else load_class("hand", options["name"])
    hand = _construct(hand_class, options)
    assert isinstance(hand, Hand)
    return hand


def build_representation(config: Mapping[str, Any], hand: "Hand", channels: int) -> "Representation":
    """Return the representation of a composed config, as `build_hand`."""
    options = _resolved("repr", config)
    return _construct(load_class("repr", options["name"]), options, hand, channels)


def build_backbone(config: Mapping[str, Any]) -> "Backbone":
    """Return the backbone of a composed config, as `build_hand`."""
    options = _resolved("backbone", config)
    return _construct(load_class("backbone", options["name"]), options)


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
        for entry in sorted(_entries(kind), key=lambda entry: entry.name)
    ]


def names(kind: str) -> list[str]:
    """Return the names of the installed plugins of one kind, sorted."""
    return sorted({entry.name for entry in _entries(kind)})


def find(kind: str, name: str) -> EntryPoint:
    """Return the one entry point of that name; `DexgraspError` where there is none or more than one."""
    found = _named(kind, name)
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
    order = {(_distribution(entry) != "dexgrasp", _package(entry)) for kind in GROUPS for entry in _entries(kind)}
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


def _entries(kind: str) -> list[EntryPoint]:
    if kind not in GROUPS:
        raise DexgraspError(f"a kind of plugin: {', '.join(GROUPS)}", repr(kind), "use one of them")
    unique = {(entry.name, entry.value, _distribution(entry)): entry for entry in entry_points(group=GROUPS[kind])}
    return list(unique.values())


def _named(kind: str, name: str) -> list[EntryPoint]:
    return [entry for entry in _entries(kind) if entry.name == name]


def _distribution(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist else "(unknown)"


def _package(entry: EntryPoint) -> str:
    return entry.module.split(".")[0]


def _base(kind: str) -> type:
    if kind == "hand":
        from dexgrasp.hand import Hand

        return Hand
    if kind == "repr":
        from dexgrasp.representation import Representation

        return Representation
    from dexgrasp.backbone import Backbone

    return Backbone


def _summary(entry: EntryPoint) -> str:
    """First line of the docstring of the class or else the module, read without importing."""
    home = package_folder(_package(entry))
    if home is None:
        return f"broken: package {_package(entry)} is not there"
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


def _options(kind: str, name: str, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """The YAML of a plugin (or at a path) with keys replaced; `{name: name}` where it has none."""
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser().resolve()
        if not path.is_file():
            raise DexgraspError(f"a YAML file of a {kind}", f"no file {path}", "check the path")
    elif (choice := next(_choices(kind, name), None)) is not None:
        path = choice
    elif kind != "hand" or find(kind, name).attr:
        find(kind, name)
        return {"name": name, **overrides}
    else:
        raise DexgraspError(
            f"conf/{kind}/{name}.yaml in the package {find(kind, name).value}", "no such file", "repair that package"
        )
    config = read(path)
    if overrides:
        from omegaconf import OmegaConf

        merged = OmegaConf.to_container(OmegaConf.merge(config, dict(overrides)), resolve=False)
        assert isinstance(merged, dict)
        config = {str(key): value for key, value in merged.items()}
    return config


def _choices(kind: str, name: str) -> Iterator[Path]:
    """YAMLs of that name: the package's own where an entry point has the name, else of any plugin (a variant)."""
    own = [conf_folder(_package(entry)) for entry in ([find(kind, name)] if _named(kind, name) else [])]
    for folder in own or [folder for _, folder in conf_folders()]:
        if folder and (path := folder / kind / f"{name}.yaml").is_file():
            yield path


def read(path: Path) -> dict[str, Any]:
    """Return a plugin's YAML: keys of the siblings in its `defaults` first, a relative `urdf` made absolute."""
    from omegaconf import OmegaConf

    import dexgrasp.config  # noqa: F401  registers the resolver that such a YAML may use

    try:
        loaded = OmegaConf.load(path)
    except Exception as error:
        raise DexgraspError(f"a readable YAML file {path}", f"{type(error).__name__}: {error}", "repair it") from error
    config = OmegaConf.to_container(loaded, resolve=False)
    if not isinstance(config, dict) or "name" not in config:
        raise DexgraspError(f"a mapping with the key `name` in {path}", f"{config!r:.80}", "add `name: ...`")
    base: dict[str, Any] = {}
    for sibling in config.pop("defaults", []):
        if sibling != "_self_":
            base |= read(path.parent / f"{sibling}.yaml")
    urdf = config.get("urdf")
    if isinstance(urdf, str) and not urdf.startswith(("${", "/", "~")):
        config["urdf"] = str(path.parent / urdf)
    return base | {str(key): value for key, value in config.items()}


def _resolved(kind: str, config: Mapping[str, Any]) -> dict[str, Any]:
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    import dexgrasp.config  # noqa: F401  registers the resolver that such a config may use

    node = config if isinstance(config, DictConfig) else OmegaConf.create(dict(config))
    try:
        options = OmegaConf.to_container(node, resolve=True)
    except OmegaConfBaseException as error:
        if isinstance(error.__cause__, DexgraspError):  # from our resolver
            raise error.__cause__ from None
        raise DexgraspError(f"a {kind} config without open ends", str(error.msg or error), "give that key") from error
    if not isinstance(options, dict) or not options.get("name"):
        raise DexgraspError(f"a {kind} config with the key `name`", f"{sorted(map(str, config))}", "add `name: ...`")
    return {str(key): value for key, value in options.items()}


def _construct(cls: type, options: dict[str, Any], *args: Any) -> Any:
    """Call the class; keys that its constructor does not have are an error of the config."""
    parameters = inspect.signature(cls).parameters
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    keywords = {key: value for key, value in options.items() if key != "name" or "name" in parameters}
    known = [name for name in list(parameters)[len(args) :] if name not in ("args", "kwargs")]
    strange = [] if open_ended else [key for key in keywords if key not in known]
    if strange:
        close = difflib.get_close_matches(strange[0], known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else "remove it"
        raise DexgraspError(f"options of {cls.__name__}: {', '.join(known)}", repr(strange[0]), hint)
    required = [name for name in known if parameters[name].default is inspect.Parameter.empty]
    missing = [
        name
        for name in required
        if name not in keywords
        and parameters[name].kind not in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    ]
    if missing:
        raise DexgraspError(
            f"all of {', '.join(required)} for {cls.__name__}", f"no {', '.join(missing)}", "add it to the YAML"
        )
    return cls(*args, **keywords)
