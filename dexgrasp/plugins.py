"""Hands, representations, backbones and planners by name or from a composed config.

A plugin is an entry point of one of four groups. Its value names a class, or for a hand a package that holds only a
YAML and a URDF. Its YAML, ``<package>/conf/<kind>/<name>.yaml``, has the key `name`, which picks the entry point, and
constructor arguments.
"""

import difflib
import inspect
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexgrasp.errors import DexgraspError, UnknownOptions
from dexgrasp.registry import GROUPS, conf_folder, conf_folders, find, installed, load_class, named, names, top_package

if TYPE_CHECKING:
    from dexgrasp.backbone import Backbone
    from dexgrasp.hand import Hand
    from dexgrasp.planner import Planner
    from dexgrasp.representation import Representation

__all__ = [
    "GROUPS",
    "build_backbone",
    "build_hand",
    "build_planner",
    "build_representation",
    "conf_folders",
    "construct",
    "hand_options",
    "installed",
    "load_backbone",
    "load_class",
    "load_hand",
    "load_planner",
    "load_representation",
    "names",
    "read",
    "resolved",
]


def load_hand(name: str, **overrides: Any) -> "Hand":
    """Return the installed hand `name`, or the hand of the YAML file at path `name`.

    `overrides` replace keys of its YAML. Raises `DexgraspError` for an unknown or broken hand.
    """
    return build_hand(_options("hand", name, overrides))


def hand_options(name: str) -> dict[str, Any]:
    """Return what the YAML of a hand says, by name or path, every `${...}` replaced; nothing is loaded."""
    return resolved("hand", _options("hand", name, {}))


def load_representation(name: str, hand: "Hand", channels: int = 128, **options: Any) -> "Representation":
    """Return the representation `name` of `hand`, with heads for point features of size `channels`."""
    return build_representation(_options("repr", name, options), hand, channels)


def load_backbone(name: str, **options: Any) -> "Backbone":
    """Return the backbone `name`; `options` replace keys of its YAML."""
    return build_backbone(_options("backbone", name, options))


def load_planner(name: str, hand: "Hand", **options: Any) -> "Planner":
    """Return the planner `name` for `hand`; `options` replace keys of its YAML."""
    return build_planner(_options("planner", name, options), hand)


def build_hand(config: Mapping[str, Any]) -> "Hand":
    """Return the hand of a composed config: `name` picks the entry point, other keys are constructor arguments.

    A name that is not installed is fine where `urdf` and `fingers` are given: a hand in a plain folder.
    """
    from dexgrasp.hand import Hand
    from dexgrasp.urdf import UrdfHand

    options = resolved("hand", config)
    plain = {"urdf", "fingers"} <= options.keys() and not named("hand", options["name"])
    hand_class = UrdfHand if plain or not find("hand", options["name"]).attr else load_class("hand", options["name"])
    hand = construct(hand_class, options)
    assert isinstance(hand, Hand)
    return hand


def build_representation(config: Mapping[str, Any], hand: "Hand", channels: int) -> "Representation":
    """Return the representation of a composed config, as `build_hand`."""
    options = resolved("repr", config)
    return construct(load_class("repr", options["name"]), options, hand, channels)


def build_backbone(config: Mapping[str, Any]) -> "Backbone":
    """Return the backbone of a composed config, as `build_hand`."""
    options = resolved("backbone", config)
    return construct(load_class("backbone", options["name"]), options)


def build_planner(config: Mapping[str, Any], hand: "Hand") -> "Planner":
    """Return the planner of a composed config for `hand`, as `build_hand`."""
    options = resolved("planner", config)
    return construct(load_class("planner", options["name"]), options, hand)


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
    own = [conf_folder(top_package(entry)) for entry in ([find(kind, name)] if named(kind, name) else [])]
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


def resolved(kind: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config's keys, every `${...}` replaced; raises DexgraspError where one is open or `name` is missing."""
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


def construct(cls: type, options: dict[str, Any], *args: Any) -> Any:
    """Return ``cls(*args, **options)``; raises UnknownOptions for keys that it does not have, and for missing ones."""
    parameters = inspect.signature(cls).parameters
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    keywords = {key: value for key, value in options.items() if key != "name" or "name" in parameters}
    known = [name for name in list(parameters)[len(args) :] if name not in ("args", "kwargs")]
    strange = [] if open_ended else [key for key in keywords if key not in known]
    if strange:
        close = difflib.get_close_matches(strange[0], known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else "remove it"
        raise UnknownOptions(f"options of {cls.__name__}: {', '.join(known)}", repr(strange[0]), hint)
    required = [name for name in known if parameters[name].default is inspect.Parameter.empty]
    missing = [
        name
        for name in required
        if name not in keywords
        and parameters[name].kind not in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    ]
    if missing:
        raise UnknownOptions(
            f"all of {', '.join(required)} for {cls.__name__}", f"no {', '.join(missing)}", "add it to the YAML"
        )
    return cls(*args, **keywords)
