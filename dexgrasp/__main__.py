"""The command line: ``python -m dexgrasp <command> [overrides | arguments]``."""

import os
import signal
import sys
import threading
from importlib import import_module
from pathlib import Path
from types import FrameType

from dexgrasp.errors import DexgraspError, room

PIPELINES = {
    "dataset": "objects -> grasps -> scenes -> views -> labels; dataset estimate|inspect|verify|merge|export|card",
    "train": "train a network, evaluate it in physics, show the result",
    "eval": "a network (model=RUN) or planner (planner=NAME) in physics; grasps=FILE: a set under several protocols",
    "fit": "teach a planner (a baseline that learns) on a dataset",
    "study": "compare methods under several rules, in tables: experiment=quick_benchmark",
    "predict": "grasps for one point cloud or depth image",
    "export": "a trained network as ONNX or torch.export, checked; or as weights of the package: model=RUN [ship=NAME]",
    "fidelity": "how much of a grasp each representation keeps",
}
"""Hydra apps: ``key=value`` overrides; config ``conf/<command>.yaml``."""

TOOLS = {
    "plugins": "list installed hands, representations and backbones",
    "hand": "hand check <name>: look a hand over; hand init <file>: write one from a URDF",
    "convert": "other people's grasps: what is in a file, and into another format: convert <file> [--to FILE]",
    "view": "look at a dataset, prediction, evaluation or hand in the browser: view PATH [--scene 3]",
    "report": "one leaderboard over any set of runs, HTML and Markdown: report RUN...",
}
"""Ordinary arguments."""

VERBS = {"dataset": ("inspect", "verify", "merge", "export", "card")}
"""First words that make a pipeline's command a tool: the module's `tool(arguments)` runs it."""

PARTS = {("dataset", "estimate"): "estimate"}
"""First words that make a pipeline's command another pipeline, with a config and a module of its own."""

VALUED = "--cfg -c --package -p --config-path -cp --config-name -cn --config-dir -cd --experimental-rerun --info -i"
"""Hydra's flags whose value is the next word."""


def main(argv: list[str] | None = None) -> int:
    """Run one command; return the exit status (2 for a user's error, 130 for Ctrl-C)."""
    argv = sys.argv[1:] if argv is None else argv
    command, rest = (argv[0], argv[1:]) if argv else ("--help", [])
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _interrupt)
    try:
        if command in ("-h", "--help", "help"):
            print(usage())
            return 0
        if command in TOOLS:
            return int(import_module(f"dexgrasp.commands.{command}").main(rest) or 0)
        if rest[:1] and rest[0] in VERBS.get(command, ()):
            return int(import_module(f"dexgrasp.commands.{command}").tool(rest) or 0)
        if command == "eval" and any(word.startswith("grasps=") for word in rest):
            # For Hydra `protocol` is a group, of which it takes one.
            return pipeline(
                "score",
                [word.replace("protocol=", "protocols=", 1) if word.startswith("protocol=") else word for word in rest],
            )
        if (command, *rest[:1]) in PARTS:
            return pipeline(PARTS[command, rest[0]], rest[1:])
        if command in PIPELINES:
            return tool(command, rest) if rest and rest[0].isidentifier() else pipeline(command, rest)
        from dexgrasp.registry import unknown

        raise unknown("command", command, [*PIPELINES, *TOOLS])
    except DexgraspError as error:
        print(f"dexgrasp {command}: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `... | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print(f"\ndexgrasp {command}: interrupted", file=sys.stderr)
        return 130


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Do on SIGTERM, with which batch systems take a machine back, what Ctrl-C does now."""
    handler = signal.getsignal(signal.SIGINT)
    (handler if callable(handler) else signal.default_int_handler)(number, frame)


def tool(command: str, arguments: list[str]) -> int:
    """Run a pipeline's tool, e.g. ``dataset inspect <path>``: ordinary arguments, no `key=value`."""
    run = getattr(import_module(f"dexgrasp.commands.{command}"), "tool", None)
    if run is None:
        raise DexgraspError(f"key=value after `{command}`", repr(arguments[0]), f"see `{command} --help`")
    return int(run(arguments) or 0)


def usage() -> str:
    """Return the text of ``--help``."""
    width = max(map(len, [*PIPELINES, *TOOLS]))
    lines = ["usage: python -m dexgrasp <command> [key=value ... | arguments]", "", "pipelines (key=value):"]
    lines += [f"  {name:{width}}  {text}" for name, text in PIPELINES.items()]
    lines += ["", "tools:", *(f"  {name:{width}}  {text}" for name, text in TOOLS.items())]
    return "\n".join(
        [*lines, "", "`python -m dexgrasp <command> --help` lists its options and every installed choice."]
    )


def pipeline(command: str, arguments: list[str]) -> int:
    """Run a Hydra app; `HYDRA_FULL_ERROR=1` shows tracebacks as Hydra has them."""
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    from dexgrasp import config, overrides

    full = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing and exiting: the wording is ours
    config.register()
    arguments, words = _overrides_last(arguments)
    sys.argv = [f"dexgrasp {command}", *arguments]
    start = hydra.main(version_base="1.3", config_path=str(config.conf_folder()), config_name=command)
    try:
        with room("a run's folder", Path.cwd()):
            start(config.Task(command))()
    except config.Refused as refused:
        assert isinstance(refused.__cause__, Exception)
        if full:
            raise refused.__cause__ from None
        raise overrides.explain(refused.__cause__, command, words) from None
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        if full:
            raise
        raise overrides.explain(error, command, words) from error
    except ValueError as error:
        if full or not str(error).startswith("Only one of --run"):
            raise
        raise DexgraspError("one of -m, --cfg and --info", " ".join(arguments), "try --cfg without -m") from error
    finally:
        if not isinstance(sys.exception(), KeyboardInterrupt):
            config.compare(command)
    return 0


def _overrides_last(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return the arguments with overrides behind all flags, and the overrides: Hydra takes them in one piece only."""
    flags: list[str] = []
    words: list[str] = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        (flags if word.startswith("-") or before in VALUED.split() else words).append(word)
    return [*flags, *words], words


if __name__ == "__main__":
    sys.exit(main())
