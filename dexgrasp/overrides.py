"""What is wrong with a command line: Hydra's errors in our words."""

import difflib
import re

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from dexgrasp.config import conf_folder
from dexgrasp.errors import DexgraspError
from dexgrasp.registry import GROUPS, unknown


def explain(error: Exception, command: str, overrides: list[str]) -> DexgraspError:
    """Return the error to show for one that Hydra or OmegaConf raised."""
    cause: BaseException | None = error
    while cause is not None:  # ours, raised inside a resolver or an instantiation
        if isinstance(cause, DexgraspError):
            return cause
        cause = cause.__cause__ or cause.__context__
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        told = unknown(group or "config", name.removesuffix(".yaml"), sorted(error.options))
        if group in GROUPS:
            return told
        hint, listed = told.remedy.split("`")[0], f"`python -m dexgrasp {command} --help` lists them"
        return DexgraspError(f"a choice of {group}: {', '.join(sorted(error.options))}", told.found, hint + listed)
    if isinstance(error, OverrideParseException):
        return DexgraspError("overrides as key=value", repr(error.override), f"quote it for the shell: {error.message}")
    if isinstance(error, YAMLError):
        return DexgraspError("configs in YAML", " ".join(str(error).split()), "correct that file")
    if isinstance(error, MissingMandatoryValue):
        key = getattr(error, "full_key", None) or "a value"
        return DexgraspError(f"a value for {key}", "none", f"give it: {key}=...")
    wrong = re.search(r"Could not override '([^']+)'", str(error)) or re.search(r"Key '([^']+)' is not in", str(error))
    if wrong and isinstance(error, HydraException):
        return _strange_key(wrong.group(1), command, overrides)
    reason = getattr(error, "msg", None) or str(error)
    if isinstance(error.__cause__, OmegaConfBaseException):
        reason += f" ({error.__cause__.msg})"
    lines = " ".join(reason.split("Config search path:")[0].split())
    return DexgraspError(
        f"a config that composes for `{command}`", lines, "correct the override or the YAML named there"
    )


def _strange_key(key: str, command: str, overrides: list[str]) -> DexgraspError:
    key = key.split("@")[0]
    others = [override for override in overrides if _key(override) != key]
    known = _known_keys(command, others)
    if key in known:
        return DexgraspError(f"a group in the defaults of `{command}`", repr(key), f"add it: +{key}=...")
    leaf = key.rpartition(".")[2]
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.75) or [
        name for close in difflib.get_close_matches(leaf, [k.rpartition(".")[2] for k in known], n=1, cutoff=0.75)
        for name in known if name.rpartition(".")[2] == close
    ]  # fmt: skip
    hint = f"did you mean {near[0]!r}? " if near else ""
    return DexgraspError(
        f"a setting of `{command}`",
        f"{key!r}, which is none",
        f"{hint}`python -m dexgrasp {command} --help` lists them",
    )


def _key(override: str) -> str:
    return override.lstrip("+~").split("=")[0].split("@")[0]


def _known_keys(command: str, overrides: list[str]) -> list[str]:
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        try:
            config = compose(
                command, [override for override in overrides if "," not in override and "(" not in override]
            )
        except (HydraException, OmegaConfBaseException):
            config = compose(command)
        app = GlobalHydra.instance().hydra
        groups = [group for group in app.list_all_config_groups() if not group.startswith("hydra")] if app else []
    return groups + _leaves(config)


def _leaves(config: DictConfig, prefix: str = "") -> list[str]:
    keys: list[str] = []
    for key in map(str, config):
        path = f"{prefix}{key}"
        node = config._get_node(key) if not OmegaConf.is_missing(config, key) else None
        keys.append(path)
        if isinstance(node, DictConfig) and not node._is_interpolation() and not node._is_none():
            keys += _leaves(node, f"{path}.")
    return keys
