"""Hydra as the command line uses it: search path, our resolvers (`package`, `data`), one wrapper round every task."""

import itertools
import logging
import shutil
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from dexgrasp import kernel_cache, launcher, registry, usage
from dexgrasp.errors import DexgraspError, room

log = logging.getLogger(__name__)


def package(name: str) -> str:
    """Resolve `${package:name}`: the folder of an installed package, found without importing it."""
    folder = registry.package_folder(name)
    if folder is None:
        raise DexgraspError(f"an installed package {name!r}", "none", "install the distribution that holds it")
    return str(folder)


def data(name: str, path: str) -> str:
    """Resolve `${data:distribution,path}`: a data file of an installed distribution, by the end of its path."""
    found = registry.installed_file(name, path)
    if found is None:
        raise DexgraspError(f"a file {path!r} in the installed distribution {name!r}", "none", f"pip install {name}")
    return str(found)


# At import, so that it is there in every worker process that unpickles a task or a config.
OmegaConf.register_new_resolver("package", package, replace=True)
OmegaConf.register_new_resolver("data", data, replace=True)
# Hydra writes what it was told into a run's folder; the words that resume a run must not take the place of the first.
OmegaConf.register_new_resolver("notes", lambda resume: ".hydra" if resume is None else ".hydra/resumed", replace=True)
OmegaConf.register_new_resolver("usage", usage.text, replace=True)
OmegaConf.register_new_resolver("first", lambda *values: next((v for v in values if v is not None), None), replace=True)


def conf_folder() -> Path:
    """Return the folder of our own configs (inside the package in a wheel, beside it in a source tree)."""
    folder = registry.conf_folder("dexgrasp")
    if folder is None:
        raise DexgraspError("the folder conf of dexgrasp", "none", "reinstall dexgrasp")
    return folder


class PluginSearchPath(SearchPathPlugin):
    """Appends the `conf/` of every installed plugin; as files, because `pkg://` would import the plugin."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for name, folder in registry.conf_folders():
            search_path.append(provider=name, path=f"file://{folder}")


def register() -> None:
    """Make Hydra know the plugins and our launcher; call before Hydra starts."""
    Plugins.instance().register(PluginSearchPath)
    launcher.register()


class Refused(BaseException):
    """Carries an error in the user's input past Hydra, which would print a line of its own about an Exception."""


class Task:
    """What Hydra runs: a command's `main`, found by name so that it pickles to other processes."""

    def __init__(self, command: str) -> None:
        self.command = command
        self.__name__ = command
        self.__module__ = f"dexgrasp.commands.{command}"  # from which Hydra takes the job's name

    def __call__(self, config: DictConfig) -> None:
        if kernel_cache.cold():
            log.info("first use: kernels are compiled as they are needed, about a minute of processor time, once")
        main: Callable[[DictConfig], None] = import_module(f"dexgrasp.commands.{self.command}").main
        try:
            with room("what a run writes", Path.cwd()):
                place_urdf(config)
                main(config)
        except (DexgraspError, HydraException, OmegaConfBaseException) as error:
            if HydraConfig.get().mode is not RunMode.RUN:  # one of several: Hydra takes note and goes on
                raise
            Folders.leave()
            raise Refused from error


class Folders(Callback):
    """Where runs write: a folder of its own for each, gone again where a run refuses its input, known for comparison.

    The folder of a multirun is kept, so that its runs can be compared even if some have failed.
    """

    multirun: Path | None = None
    made: tuple[Path, ...] = ()
    """Folders that were not there before this run, innermost first."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.run.dir).absolute()
        Folders.made = tuple(itertools.takewhile(lambda path: not path.exists(), [folder, *folder.parents]))
        if _timed(config.hydra.run) and not config.get("resume"):
            folder = _claim(folder)
            Folders.made = (folder, *Folders.made[1:])
            with open_dict(config):
                config.hydra.run.dir = str(folder)

    @staticmethod
    def leave() -> None:
        """Take away this run's folder where it holds nothing but what every run begins with."""
        if not Folders.made:
            return
        own = {".hydra", "config.yaml", f"{HydraConfig.get().job.name}.log"}
        if {path.name for path in Folders.made[0].iterdir()} <= own:
            root = logging.getLogger()
            for handler in [each for each in root.handlers if isinstance(each, logging.FileHandler)]:
                root.removeHandler(handler)
                handler.close()
            Folders.remove()

    @staticmethod
    def remove() -> None:
        """Take away the folder that was made, and those above it that were made for it and are empty now."""
        shutil.rmtree(Folders.made[0])
        for folder in Folders.made[1:]:
            if any(folder.iterdir()):
                break
            folder.rmdir()

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir).absolute()
        Folders.made = tuple(itertools.takewhile(lambda path: not path.exists(), [folder, *folder.parents]))
        if _timed(config.hydra.sweep):
            folder = _claim(folder)
            Folders.made = (folder, *Folders.made[1:])
            with open_dict(config):
                config.hydra.sweep.dir = str(folder)
                config.hydra.overrides.hydra.append(f"hydra.sweep.dir={_quoted(str(folder))}")  # jobs compose anew
        Folders.multirun = folder


def compare(command: str) -> None:
    """After a multirun, call the command's `compare(folder)` where it has one; one that began no run leaves nothing."""
    folder = Folders.multirun
    if folder is None or not folder.is_dir():
        return
    if Folders.made[:1] == (folder,) and {path.name for path in folder.iterdir()} <= {"multirun.yaml"}:
        Folders.remove()
        return
    hook = getattr(import_module(f"dexgrasp.commands.{command}"), "compare", None)
    if hook is not None:
        hook(folder)


def _timed(where: DictConfig) -> bool:
    """Whether a folder is named by the time, so that it shall be new; one that the user names may be there already."""
    return "${now:" in str(where._get_node("dir")._value())  # type: ignore[union-attr]


def _quoted(text: str) -> str:
    """Return a value for an override, whatever characters it has."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _claim(folder: Path) -> Path:
    """Make a folder that nobody else has, of that name or, where two runs begin in one second, with a number."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        own = folder if number == 1 else folder.with_name(f"{folder.name}_{number}")
        try:
            own.mkdir()
            return own
        except FileExistsError:
            continue
    raise AssertionError


def place_urdf(config: DictConfig) -> None:
    """Make a relative `hand.urdf` absolute: it is relative to the YAML, which lies in one of Hydra's folders."""
    hand = OmegaConf.select(config, "hand")
    urdf = OmegaConf.to_container(hand, resolve=False).get("urdf") if isinstance(hand, DictConfig) else None  # type: ignore[union-attr]
    if not isinstance(urdf, str) or urdf.startswith(("${", "/", "~")):
        return
    folders = [
        Path(source.path) / "hand"
        for source in HydraConfig.get().runtime.config_sources
        if source.schema == "file" and source.path
    ]
    found = next((folder / urdf for folder in folders if (folder / urdf).is_file()), None)
    if found is None:
        listed = ", ".join(map(str, folders))
        raise DexgraspError(
            f"the URDF {urdf!r} of hand {hand.get('name')!r} beside its YAML", f"none in {listed}", "check hand.urdf"
        )
    with open_dict(hand):
        hand.urdf = str(found.resolve())
