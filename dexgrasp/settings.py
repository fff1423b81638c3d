"""Dataclasses from configs, with every key and every kind of value checked before anything is done."""

import dataclasses
import math
import types
from collections.abc import Mapping
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from omegaconf import OmegaConf

from dexgrasp.errors import DexgraspError

T = TypeVar("T")


def read(kind: type[T], config: Mapping[str, Any], where: str) -> T:
    """Build the dataclass `kind` from a resolved or composed config; lists become tuples.

    Raises DexgraspError for a key that is unknown or missing, and for a value that is not of the field's type.
    """
    given = OmegaConf.to_container(config, resolve=True) if OmegaConf.is_config(config) else dict(config)
    assert isinstance(given, dict)
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    hints = get_type_hints(kind)
    known = [field.name for field in fields]
    required = [
        field.name
        for field in fields
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    ]
    strange = [str(key) for key in given if key not in known]
    missing = [key for key in required if key not in given]
    if strange or missing:
        found = f"{', '.join(strange)}, which is none" if strange else f"no {', '.join(missing)}"
        remedy = "correct or remove it" if strange else "add it"
        raise DexgraspError(f"keys of {where}: {', '.join(known)}", found, remedy)
    values = {str(key): tuple(value) if isinstance(value, list) else value for key, value in given.items()}
    for key, value in values.items():
        if not _fits(hints[key], value):
            raise DexgraspError(f"{where}.{key} to be {_words(hints[key])}", repr(given[key]), f"set {where}.{key}")
    return kind(**values)


def _fits(hint: Any, value: Any) -> bool:
    if get_origin(hint) in (Union, types.UnionType):
        return any(_fits(part, value) for part in get_args(hint))
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        parts = parts[:1] * len(value) if isinstance(value, tuple) and parts[-1:] == (...,) else parts
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(_fits, parts, value))
    if hint is float:  # .inf is a limit that never binds
        return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
    if hint is type(None):
        return value is None
    return type(value) is hint if hint in (int, str, bool) else True


def _words(hint: Any) -> str:
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(map(_words, get_args(hint)))
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        return f"a list of {_words(parts[0])}" if parts[-1:] == (...,) else f"a list of {len(parts)}"
    names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false", type(None): "null"}
    return names.get(hint, str(hint))
