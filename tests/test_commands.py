"""The command line: what it lists, what it accepts, how it fails, where it writes."""

import os
import signal
import subprocess
import sys
import time
import types
from importlib.util import find_spec

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from dexgrasp import __main__ as cli
from dexgrasp import config, launcher, overrides, plugins
from dexgrasp.errors import DexgraspError

CONF = config.conf_folder()
COMMANDS = sorted(path.stem for path in CONF.glob("*.yaml") if path.stem in cli.PIPELINES)
TRAIN = """defaults: [run, hand: barrett, part: small, _self_]
trainer: {steps: 3, rate: 0.1}
input: null
needed: ???  # comments say what a key is for
seed: 1
"""
SEEN = []


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Hydra starts anew each time, whatever a test before has done."""
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(config.Folders, "multirun", None)
    config.register()
    yield
    GlobalHydra.instance().clear()


@pytest.fixture
def command(monkeypatch, tmp_path, capfd):
    """A pipeline `probe` with a config of its own; command(arguments) gives exit status, output and error output."""
    folder = tmp_path / "conf"
    (folder / "part").mkdir(parents=True)
    (folder / "probe.yaml").write_text(TRAIN)
    (folder / "run.yaml").write_text((CONF / "run.yaml").read_text())
    for part in ("small", "large"):
        (folder / "part" / f"{part}.yaml").write_text(f"size: {part}\n")
    (tmp_path / "elsewhere").mkdir()
    module = types.ModuleType("dexgrasp.commands.probe")
    module.main = SEEN.append
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(cli.PIPELINES, "probe", "for tests")
    monkeypatch.setattr(config, "conf_folder", lambda: folder)
    monkeypatch.setattr(overrides, "conf_folder", lambda: folder)
    monkeypatch.chdir(tmp_path / "elsewhere")
    SEEN.clear()

    def run(*arguments):
        try:
            status = cli.main(["probe", *arguments])
        except SystemExit as error:
            status = error.code
        return status, *capfd.readouterr()

    run.module = module
    run.folder = tmp_path
    return run


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_help_lists_every_command(capsys, arguments):
    assert cli.main(arguments) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    assert listed == [*cli.PIPELINES, *cli.TOOLS]


@pytest.mark.parametrize("name", [*cli.PIPELINES, *cli.TOOLS])
def test_every_listed_command_is_there(name):
    assert find_spec(f"dexgrasp.commands.{name}"), "listed, but not there"
    if name in cli.PIPELINES:
        assert (CONF / f"{name}.yaml").is_file()


@pytest.mark.parametrize("name", ["trian", "evla", "dataste"])
def test_unknown_commands_say_what_was_meant(capsys, name):
    assert cli.main([name]) == 2
    meant = {"trian": "train", "evla": "eval", "dataste": "dataset"}[name]
    assert f"did you mean '{meant}'" in capsys.readouterr().err


def test_a_run_has_the_jobs_name_and_its_folder_below_the_working_directory(command):
    status, _, _ = command("seed=5", "part=large")
    assert status == 0
    assert (SEEN[0].seed, SEEN[0].part.size, SEEN[0].hand.name) == (5, "large", "barrett")
    assert isinstance(SEEN[0], DictConfig)
    (folder,) = (command.folder / "elsewhere/runs/probe").iterdir()
    assert OmegaConf.load(folder / ".hydra/config.yaml").seed == 5


def test_help_lists_every_installed_choice(command):
    status, out, _ = command("--help")
    assert status == 0 and "python -m dexgrasp probe" in out
    choices = {
        line.split(":")[0]: line.split(":")[1].replace(",", "").split() for line in out.splitlines() if ": " in line
    }
    assert set(plugins.names("hand")) <= set(choices["hand"]) and "planner" not in choices, "its own groups alone"
    assert choices["part"] == ["large", "small"]
    assert "trainer:" in out and not SEEN
    assert "needed: ???  # comments say what a key is for" in out and out.count("needed") == 1 and "hydra:" not in out


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (["hand=baret"], ["an installed hand: ", "barrett", "'baret'", "did you mean 'barrett'"]),
        (["part=smal"], ["part", "did you mean 'small'", "large, small"]),
        (["trainer.step=3"], ["'trainer.step'", "did you mean 'trainer.steps'"]),
        (["trainer.ratte=3"], ["did you mean 'trainer.rate'"]),
        (["sed=3"], ["did you mean 'seed'"]),
        (["hnd=barrett"], ["did you mean 'hand'"]),
        (["backbone=pointnet"], ["+backbone=..."]),
        (["x y="], ["key=value", "quote it"]),
        (["--config-dir", "nowhere"], ["nowhere", "not found"]),
        (["hand.urdf=${package:dexgrasp_nowhere}/a.urdf", "seed=${hand.urdf}"], ["dexgrasp_nowhere"]),
        (["word"], ["key=value", "'word'"]),
        (["-m", "seed=1,2", "--cfg", "job"], ["one of -m, --cfg", "without -m"]),
    ],
)
def test_a_wrong_command_line_is_told_in_one_message(command, wrong, expected):
    command.module.main = lambda config: OmegaConf.to_container(config, resolve=True)
    status, out, err = command(*wrong)
    assert status == 2, out + err
    for part in expected:
        assert part in err
    assert "Traceback" not in out + err and not SEEN
    assert err.count("expected ") == 1 and "found" in err and "to do" in err


def test_a_missing_value_is_named(command):
    command.module.main = lambda config: config.needed
    status, _, err = command()
    assert status == 2 and "needed=..." in err and "Traceback" not in err


def test_bad_input_within_a_command_is_one_message(command):
    def fail(config):
        raise DexgraspError("32 points or more", "3", "move the camera nearer")

    command.module.main = fail
    status, _, err = command()
    assert status == 2 and "32 points or more" in err and "Traceback" not in err


def test_a_bug_keeps_its_traceback(command):
    command.module.main = lambda config: 1 / 0
    with pytest.raises(ZeroDivisionError):
        command()


def test_ctrl_c_is_one_line_and_130(command):
    def interrupt(config):
        raise KeyboardInterrupt

    command.module.main = interrupt
    status, _, err = command()
    assert status == 130 and err.strip().endswith("interrupted") and "Traceback" not in err


def test_a_hand_in_a_plain_folder_is_a_choice(command):
    folder = command.folder / "mine"
    (folder / "hand").mkdir(parents=True)
    urdf = "urdf: mine.urdf\n"
    (folder / "hand/mine.yaml").write_text("name: mine\n" + urdf + "fingers: []\n")
    status, _, err = command("--config-dir", str(folder), "hand=mine")
    assert status == 2 and "mine.urdf" in err and str(folder / "hand") in err
    (folder / "hand/mine.urdf").write_text("<robot/>")
    status, _, err = command("--config-dir", "../mine", "hand=mine")
    assert status == 0, err
    assert SEEN[-1].hand.urdf == str(folder / "hand/mine.urdf")
    assert command("seed=7", "--config-dir", "../mine", "hand=mine", "--cfg", "job", "part=large")[0] == 0
    assert command("seed=7", "--config-dir", "../mine", "hand=mine")[0] == 0 and SEEN[-1].seed == 7
    status, out, _ = command("--config-dir", str(folder), "--help")
    assert next(line for line in out.splitlines() if line.startswith("hand:")) == "hand: " + ", ".join(
        sorted([*plugins_choices("hand"), "mine"])
    )


def test_a_yaml_that_is_none_breaks_only_its_own_choice(command):
    folder = command.folder / "mine"
    (folder / "hand").mkdir(parents=True)
    (folder / "hand/mine.yaml").write_text("name: [mine\n")
    status, _, err = command("--config-dir", str(folder), "hand=mine")
    assert status == 2 and "mine.yaml" in err and "Traceback" not in err
    assert command("--config-dir", str(folder), "hand=barrett")[0] == 0


def plugins_choices(kind):
    return {path.stem for _, folder in plugins.conf_folders() for path in (folder / kind).glob("*.yaml")}


def test_a_glob_sweeps_every_installed_hand_and_the_runs_are_compared(command):
    compared = []
    command.module.compare = compared.append
    status, _, err = command("-m", "hand=glob(*)", "seed=1,2", "hydra/launcher=basic")
    assert status == 0, err
    assert {seen.hand.name for seen in SEEN} == set(plugins.names("hand"))
    assert len(SEEN) == 2 * len(plugins_choices("hand"))
    (folder,) = (command.folder / "elsewhere/runs/probe").iterdir()
    assert compared == [folder] and folder.name.endswith("_multirun")
    assert {path.name for path in folder.iterdir() if path.is_dir()} == {str(i) for i in range(len(SEEN))}


def test_multiruns_of_one_second_have_folders_of_their_own(command):
    compared = []
    command.module.compare = compared.append
    where = r"hydra.sweep.dir='it\'s ${now:%Y}_multirun'"  # one time for both
    for _ in range(2):
        assert command("-m", "seed=1,2", where, "hydra/launcher=basic")[0] == 0
    first, second = sorted((command.folder / "elsewhere").iterdir())
    assert (first.name[:5], second.name) == ("it's ", f"{first.name}_2") and compared == [first, second]
    for folder in (first, second):
        assert {path.name for path in folder.iterdir()} == {"0", "1", "multirun.yaml"}
        for job in ("0", "1"):
            assert OmegaConf.load(folder / job / ".hydra/hydra.yaml").hydra.runtime.output_dir == str(folder / job)


@pytest.mark.parametrize("wrong", ["part=smal,large", "sed=1,2"])
@pytest.mark.parametrize("launcher", ["basic", "local", "submitit_local"])
def test_a_multirun_that_begins_no_run_leaves_nothing(command, wrong, launcher):
    if launcher == "submitit_local":
        pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    status, out, err = command("-m", wrong, f"hydra/launcher={launcher}")
    assert status == 2 and "did you mean" in err and "Traceback" not in out + err
    assert not list((command.folder / "elsewhere").iterdir())


def test_a_pipelines_tool_takes_ordinary_arguments(command):
    command.module.tool = SEEN.append
    assert command("inspect", "some/path=odd")[0] == 0
    assert SEEN == [["inspect", "some/path=odd"]]


PROBE = """
import os, sys, time
from dexgrasp import config
class Probe(config.Task):
    def __call__(self, cfg):
        assert os.environ["OMP_NUM_THREADS"]
        print("says", cfg.seed, flush=True)
        if cfg.seed == 7: raise ValueError("seven")
        if cfg.seed == 8: os._exit(3)
        if cfg.seed == 9:
            try: time.sleep(600)
            except KeyboardInterrupt: print("saved", flush=True); raise
        while cfg.seed == 10:
            try: print(os.getpid(), flush=True); time.sleep(600)
            except KeyboardInterrupt: print("deaf", flush=True)
if __name__ == "__main__":
    import probe
    from dexgrasp import __main__ as cli, overrides
    from pathlib import Path
    config.Task = probe.Probe
    folder = Path(sys.argv[1])
    config.conf_folder = overrides.conf_folder = lambda: folder
    cli.PIPELINES["probe"] = ""
    sys.modules["dexgrasp.commands.probe"] = probe
    sys.exit(cli.main(["probe", *sys.argv[2:]]))
"""


@pytest.fixture
def multirun(command):
    """Start a multirun of `probe` in a process of its own, as a shell does."""
    (command.folder / "probe.py").write_text(PROBE)
    environment = {**os.environ, "PYTHONPATH": str(command.folder)}

    def start(*arguments):
        words = [sys.executable, str(command.folder / "probe.py"), str(command.folder / "conf"), "-m", *arguments]
        return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)

    start.runs = command.folder / "elsewhere/runs/probe"
    return start


def outputs(runs):
    return {path.parent.name: path.read_text() for path in runs.glob("*/*/output.txt")}


def test_jobs_run_side_by_side_and_one_may_fail_alone(multirun):
    out, err = (process := multirun("seed=1,7,8,2", "hydra.launcher.workers=2")).communicate(timeout=600)
    assert process.returncode == 2, out + err
    assert "2 failed" in err and "#1 (seed=7): ValueError('seven')" in err and "exit status 3" in err
    assert "Traceback" not in err
    found = outputs(multirun.runs)
    assert {key: text.splitlines()[0] for key, text in found.items()} == {
        str(i): f"says {seed}" for i, seed in enumerate((1, 7, 8, 2))
    }
    assert "ValueError: seven" in found["1"], "the whole traceback is in the job's output"
    assert not list(multirun.runs.rglob("*.pickle"))


@pytest.mark.parametrize("launcher", ["local", "submitit_local"])
def test_launchers_send_jobs_to_the_folder_of_their_multirun(multirun, launcher):
    if launcher == "submitit_local":
        pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    words = ("seed=1,2", "hydra.sweep.dir=runs/probe/${now:%Y}", f"hydra/launcher={launcher}")
    both = [multirun(*words) for _ in range(2)]  # at the same time
    for process in both:
        _, err = process.communicate(timeout=600)
        assert process.returncode == 0, err
    found = sorted(path.relative_to(multirun.runs).parts for path in multirun.runs.glob("*/[01]/.hydra/config.yaml"))
    year = found[0][0]
    assert [part[:2] for part in found] == [(year, "0"), (year, "1"), (f"{year}_2", "0"), (f"{year}_2", "1")]


def test_ctrl_c_reaches_the_jobs_once(multirun):
    process = multirun("seed=9,9,1", "hydra.launcher.workers=2")
    until = time.monotonic() + 300
    while sum("says" in text for text in outputs(multirun.runs).values()) < 2 and time.monotonic() < until:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130 and "interrupted" in err and "Traceback" not in err
    found = outputs(multirun.runs)
    assert [text.count("saved") for text in found.values()] == [1, 1], "and the third never began"
    assert not any("Traceback" in text for text in found.values())
    assert not list(multirun.runs.glob("*/2")) and not list(multirun.runs.rglob("*.pickle"))


def test_sigterm_is_as_ctrl_c():
    program = (
        "import sys, time, types; from dexgrasp import __main__ as command;"
        "nap = lambda rest: (print('sleeps', flush=True), time.sleep(600));"
        "sys.modules['dexgrasp.commands.nap'] = types.SimpleNamespace(main=nap); command.TOOLS['nap'] = '';"
        "sys.exit(command.main(['nap']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "sleeps\n"
    process.terminate()
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err.strip() == "dexgrasp nap: interrupted"


def test_a_second_ctrl_c_ends_jobs_that_do_not_obey(multirun):
    process = multirun("seed=10,10", "hydra.launcher.workers=2")
    for word in ("says", "deaf"):
        until = time.monotonic() + 300
        while sum(word in text for text in outputs(multirun.runs).values()) < 2 and time.monotonic() < until:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130 and "Traceback" not in err
    found = outputs(multirun.runs)
    assert len(found) == 2
    for text in found.values():
        with pytest.raises(ProcessLookupError):
            os.kill(int(text.splitlines()[1]), 0)


def test_threads_are_divided_among_the_jobs(tmp_path):
    assert launcher.LocalLauncher(3).workers == 3
    assert launcher.LocalLauncher().workers == max(1, (os.cpu_count() or 1) // 2)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_config_of_every_command_composes(name):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        whole = compose(name, return_hydra_config=True)
        assert whole.hydra.run.dir.startswith("runs/"), "a run's folder lies below the working directory"
        OmegaConf.resolve(compose(name))


def choices(name):
    """(command, group=choice) for every YAML of every group that a command's config uses."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        try:
            used = compose(name, return_hydra_config=True).hydra.runtime.choices
        except HydraException:
            return []  # the test above says it
        loader = GlobalHydra.instance().hydra.config_loader
        groups = sorted(str(group) for group in used if not str(group).startswith("hydra/"))
        found = [f"{group}={choice}" for group in groups for choice in loader.get_group_options(group.split("@")[0])]
    return [pytest.param(name, text, id=f"{name}-{text}") for text in found]


config.register()
# A choice is tried with the first command that has its group.
CHOICES = list({case.values[1]: case for name in reversed(COMMANDS) for case in choices(name)}.values())


# Experiments belong to one command each, and test_study tries them.
@pytest.mark.parametrize(("name", "choice"), [case for case in CHOICES if "experiment=" not in case.values[1]])
def test_every_choice_of_every_command_composes(name, choice):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        OmegaConf.to_container(compose(name, [choice]), resolve=True)


def test_every_config_is_used():
    """No YAML that no command can reach."""
    reached = {case.values[1].split("@")[0].split("=")[0] for case in CHOICES}
    groups = {path.parent.relative_to(CONF).as_posix() for path in CONF.glob("*/**/*.yaml")}
    assert not groups - reached, "groups that no command uses"
