"""What is installed: every plugin, config and mesh, from a wheel, from an sdist, beside strangers' packages."""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import dexgrasp

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = sorted(path.parent for path in (ROOT / "plugins").glob("*/*/pyproject.toml"))
KINDS = {"hands": "hand", "representations": "repr", "backbones": "backbone", "planners": "planner"}


def build(source, target, kind):
    target.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(target)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(target.glob("*.whl" if kind == "wheel" else "*.tar.gz"))


def pip(*arguments):
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


def dexgrasp_in(sites, *arguments, cwd):
    """Run the command line with folders of installed packages before all others, `.pth` files and all."""
    code = (
        "import sys, site; before = list(sys.path); [site.addsitedir(p) for p in sys.argv[1].split(':')];"
        "sys.path[:] = [p for p in sys.path if p not in before] + before;"
        "import dexgrasp; print(dexgrasp.__file__, file=sys.stderr);"
        "from dexgrasp.__main__ import main; sys.exit(main(sys.argv[2:]))"
    )
    command = [sys.executable, "-c", code, ":".join(map(str, sites)), *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build(ROOT, tmp_path_factory.mktemp("wheel"), "wheel")


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    return build(ROOT, tmp_path_factory.mktemp("sdist"), "sdist")


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    pip("--target", folder, wheel)
    return folder


def names(wheel):
    return {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}


def wanted():
    """Every file of ours that is under version control's rules, at its place in the wheel."""
    places = {ROOT / "dexgrasp": "dexgrasp", ROOT / "conf": "dexgrasp/conf"}
    for plugin in PLUGINS:
        package = next(plugin.glob("dexgrasp_*"))
        places[package] = package.name
    skipped = {"__pycache__", ".gitkeep"}
    return {
        f"{place}/{file.relative_to(folder).as_posix()}"
        for folder, place in places.items()
        for file in folder.rglob("*")
        if file.is_file() and not skipped & set(file.parts) and file.suffix not in (".pyc", ".nbi", ".nbc")
    }


def test_every_plugin_is_a_whole_project():
    assert PLUGINS
    assert {path for path in (ROOT / "plugins").glob("*/*") if path.is_dir()} == set(PLUGINS)
    for plugin in PLUGINS:
        assert len((plugin / "README.md").read_text()) > 200, f"{plugin} needs a README: source, licence, use"
        package = next(plugin.glob("dexgrasp_*"))
        assert (package / "__init__.py").is_file(), "an editable install drops packages without any .py"
        group = package / "conf" / KINDS[plugin.parent.name]
        assert list(group.glob("*.yaml")), f"no config in {group}"


def test_root_entry_points_equal_the_plugins():
    root = {group: dict(entries) for group, entries in PROJECT["project"]["entry-points"].items()}
    joined = {}
    for plugin in PLUGINS:
        project = tomllib.loads((plugin / "pyproject.toml").read_text())["project"]
        assert project["version"] == PROJECT["project"]["version"], plugin
        for group, entries in project["entry-points"].items():
            for name, value in entries.items():
                assert name not in joined.setdefault(group, {}), f"{name} twice"
                joined[group][name] = value
    assert joined == root


def test_the_root_carries_every_plugin_package():
    packages = {path.relative_to(ROOT).as_posix() for plugin in PLUGINS for path in plugin.glob("dexgrasp_*")}
    settings = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert set(settings["only-include"]) == packages | {"dexgrasp", "conf"}
    assert settings["sources"] == {path: path.rpartition("/")[2] for path in packages} | {"conf": "dexgrasp/conf"}


def test_version_is_one():
    assert dexgrasp.__version__ == PROJECT["project"]["version"]


def test_every_requirement_has_a_lower_bound_and_a_pin():
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line and not line.startswith("#")
    }
    extras = PROJECT["project"]["optional-dependencies"].values()
    for requirement in [*PROJECT["project"]["dependencies"], *(name for extra in extras for name in extra)]:
        assert ">=" in requirement, requirement
        assert requirement.split(">=")[0].lower().replace("_", "-") in pinned, f"no pin of {requirement}"


def test_wheel_holds_everything_and_nothing_else(wheel):
    assert names(wheel) == wanted()
    assert {name.split("/")[0] for name in names(wheel)} == {
        "dexgrasp",
        *(next(p.glob("dexgrasp_*")).name for p in PLUGINS),
    }


def test_wheel_from_the_sdist_is_the_same(wheel, sdist, tmp_path):
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
        members = archive.getnames()
    assert not [name for name in members if "/runs/" in name or name.endswith(".pyc")]
    source = next(tmp_path.glob("dexgrasp-*"))
    assert names(build(source, tmp_path / "dist", "wheel")) == names(wheel)


def test_installed_wheel_works_from_another_directory(site, tmp_path):
    done = dexgrasp_in([site], "plugins", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(site) in done.stderr.splitlines()[0], "not the checkout"
    for group, entries in PROJECT["project"]["entry-points"].items():
        for name in entries:
            assert [KINDS[group.partition(".")[2]], name] in [line.split()[:2] for line in done.stdout.splitlines()]
    shown = dexgrasp_in([site], "dataset", "--cfg", "job", "--resolve", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert f"urdf: {site}" in shown.stdout
    checked = dexgrasp_in([site], "hand", "check", "barrett", "--no-files", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert list(tmp_path.iterdir()) == [], "looking leaves nothing behind"


def stranger(folder):
    """A hand package, made as a stranger makes one: our BarrettHand's folder copied and renamed."""
    shutil.copytree(ROOT / "plugins/hands/barrett", folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "dexgrasp_barrett").rename(folder / "dexgrasp_theirs")
    config = folder / "dexgrasp_theirs/conf/hand"
    text = (config / "barrett.yaml").read_text()
    for other in config.glob("*.yaml"):
        other.unlink()
    (config / "theirs.yaml").write_text(text.replace("name: barrett", "name: theirs").replace("_barrett", "_theirs"))
    project = (folder / "pyproject.toml").read_text()
    project = project.replace("dexgrasp-barrett", "dexgrasp-theirs").replace("dexgrasp_barrett", "dexgrasp_theirs")
    lines = [line for line in project.splitlines() if not line.startswith("barrett_")]
    (folder / "pyproject.toml").write_text("\n".join(lines).replace("barrett = ", "theirs = "))
    return folder


@pytest.mark.parametrize("editable", [False, True])
def test_a_hand_of_another_package_works_without_an_edit(site, tmp_path, editable):
    source, elsewhere = stranger(tmp_path / "source"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    pip(*(["--prefix", tmp_path / "theirs", "-e", source] if editable else ["--target", tmp_path / "theirs", source]))
    theirs = next((tmp_path / "theirs").rglob("dexgrasp_theirs*.dist-info")).parent
    sites = [site, theirs]

    def run(*arguments):
        done = dexgrasp_in(sites, *arguments, cwd=elsewhere)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    listed = [line.split()[:3] for line in run("plugins", "hand").splitlines()]
    assert ["hand", "theirs", "dexgrasp-theirs"] in listed and ["hand", "barrett", "dexgrasp"] in listed
    choices = next(line for line in run("dataset", "--help").splitlines() if line.startswith("hand:"))
    assert "theirs" in choices and "barrett" in choices
    config = run("dataset", "hand=theirs", "--cfg", "job", "--resolve")
    assert "name: theirs" in config and "dexgrasp_theirs/urdf" in config
    assert "FAILS" not in run("hand", "check", "theirs", "--no-files")
    assert os.listdir(elsewhere) == []
