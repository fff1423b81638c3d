"""The registry: lazy, clear in its errors, and open to strangers."""

import os
import pickle
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

import dexgrasp
from dexgrasp import plugins, registry
from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand

INERTIAL = (
    """<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>"""
)
FINGER = """<link name="{side}">{inertial}
    <collision><origin xyz="0 0 0.05"/><geometry><sphere radius="0.01"/></geometry></collision></link>
  <joint name="{side}_joint" type="revolute"><parent link="base"/><child link="{side}"/><origin xyz="{x} 0 0.03"/>
    <axis xyz="0 {axis} 0"/><limit lower="-0.5" upper="0.5" effort="1" velocity="1"/></joint>"""
HAND_URDF = f"""<robot name="pincer">
  <link name="base">{INERTIAL}<collision><geometry><box size="0.1 0.04 0.04"/></geometry></collision></link>
  {FINGER.format(side="left", x=-0.05, axis=1, inertial=INERTIAL)}
  {FINGER.format(side="right", x=0.05, axis=-1, inertial=INERTIAL)}
</robot>"""
HAND_YAML = """name: {name}
urdf: {urdf}
palm: {{origin: [0, 0, 0.02], approach: [0, 0, 1]}}
fingers:
  - {{name: left, link: left, tip_radius: 0.01, tip_center: [0, 0, 0.05]}}
  - {{name: right, link: right, tip_radius: 0.01, tip_center: [0, 0, 0.05]}}
"""


class Distribution:
    def __init__(self, name):
        self.name = name


def entry(kind, name, value, distribution="dexgrasp-theirs"):
    return EntryPoint(name=name, value=value, group=registry.GROUPS[kind])._for(Distribution(distribution))


@pytest.fixture
def register(monkeypatch):
    """Add entry points to those that are installed."""

    def add(*extra):
        real = registry.entry_points

        def entry_points(group):
            return [*real(group=group), *(e for e in extra if e.group == group)]

        monkeypatch.setattr(registry, "entry_points", entry_points)

    return add


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Make a package on the path: package("dexgrasp_theirs", {"__init__.py": ..., "conf/hand/theirs.yaml": ...})."""

    def make(name, files):
        for file, text in files.items():
            path = tmp_path / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        return tmp_path / name

    yield make
    for module in [m for m in sys.modules if m.startswith("dexgrasp_theirs")]:
        del sys.modules[module]


def run(*arguments, cwd=None, path=()):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, cwd=cwd, env=environment, timeout=600
    )


def test_public_api_is_lazy():
    code = "import sys, dexgrasp; assert 'torch' not in sys.modules; print(sorted(dir(dexgrasp)))"
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    for name in ("load_hand", "load_representation", "load_backbone", "load_model", "quality"):
        assert name in done.stdout and name in dexgrasp.__all__
    with pytest.raises(AttributeError):
        _ = dexgrasp.nothing


def test_installed_plugins_are_listed_without_importing_any():
    code = (
        "import sys; from dexgrasp.__main__ import main; assert main(['plugins']) == 0;"
        "assert not [m for m in sys.modules if m.startswith('dexgrasp_') or m == 'torch']"
    )
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    for plugin in registry.installed():
        line = next(line for line in done.stdout.splitlines() if line.split()[:2] == [plugin.kind, plugin.name])
        assert plugin.distribution in line and plugin.summary in line
    assert {"barrett"} <= set(registry.names("hand"))


def test_installed_hands_load_by_name_and_take_overrides():
    hand = dexgrasp.load_hand("barrett")
    assert hand.joint_names == ("spread", "finger_1", "finger_2", "finger_3")
    assert hand.limits.shape == (4, 2) and len(hand.fingers) == 3
    shared_by_none = dexgrasp.load_hand("barrett", shared=[])
    assert "spread" not in shared_by_none.fingers[2].main


def test_representations_and_backbones_load_with_options():
    hand = dexgrasp.load_hand("barrett")
    model = dexgrasp.load_representation("contact", hand, channels=16, refine=False)
    assert model.refine is False and model.hand is hand
    assert dexgrasp.load_backbone("pointnet", head=[32, 24]).channels == 24


@pytest.mark.parametrize(
    ("kind", "wrong", "right"),
    [("hand", "baret", "barrett"), ("repr", "contatc", "contact"), ("backbone", "pontnet2", "pointnet2")],
)
def test_unknown_names_say_what_was_meant_and_what_is_there(kind, wrong, right):
    with pytest.raises(DexgraspError) as caught:
        registry.find(kind, wrong)
    assert f"did you mean {right!r}" in str(caught.value)
    assert all(name in caught.value.expected for name in registry.names(kind))
    with pytest.raises(DexgraspError, match="did you mean"):
        {"hand": plugins.load_hand, "backbone": plugins.load_backbone}.get(kind, lambda n: registry.find(kind, n))(
            wrong
        )


def test_unknown_kinds_are_refused():
    with pytest.raises(DexgraspError, match="hand, repr, backbone"):
        registry.names("gripper")


def test_a_broken_plugin_is_named_and_the_others_work(register, package):
    package("dexgrasp_theirs", {"__init__.py": "import no_such_module\n"})
    register(entry("backbone", "theirs", "dexgrasp_theirs:Net"), entry("backbone", "gone", "dexgrasp_gone:Net"))
    with pytest.raises(DexgraspError) as caught:
        plugins.load_backbone("theirs")
    for part in ("'theirs'", "dexgrasp-theirs", "ModuleNotFoundError", "no_such_module"):
        assert part in str(caught.value)
    with pytest.raises(DexgraspError, match="dexgrasp_gone"):
        plugins.load_backbone("gone")
    assert plugins.load_backbone("pointnet").channels > 0
    listed = {plugin.name: plugin.summary for plugin in registry.installed("backbone")}
    assert "broken" in listed["gone"] and "pointnet" in listed


def test_a_missing_attribute_is_a_broken_plugin(register):
    register(entry("backbone", "theirs", "dexgrasp_pointnet:Nothing"))
    with pytest.raises(DexgraspError, match="AttributeError"):
        plugins.load_backbone("theirs")


@pytest.mark.parametrize("value", ["collections:OrderedDict", "math:pi"])
@pytest.mark.parametrize("kind", ["hand", "repr", "backbone"])
def test_a_plugin_of_the_wrong_type_is_refused(register, kind, value):
    register(entry(kind, "theirs", value))
    with pytest.raises(DexgraspError, match="subclass of dexgrasp") as caught:
        registry.load_class(kind, "theirs")
    assert "dexgrasp-theirs" in str(caught.value)


def test_an_unfinished_plugin_is_refused(register, package):
    package("dexgrasp_theirs", {"__init__.py": "from dexgrasp.backbone import Backbone\nclass Net(Backbone): pass\n"})
    register(entry("backbone", "theirs", "dexgrasp_theirs:Net"))
    with pytest.raises(DexgraspError, match=r"abstract methods: forward, plan"):
        plugins.load_backbone("theirs")


def test_two_distributions_with_one_name_matter_only_when_asked_for(register):
    register(entry("hand", "twice", "one_package", "first"), entry("hand", "twice", "other_package", "second"))
    with pytest.raises(DexgraspError) as caught:
        plugins.load_hand("twice")
    assert "first (one_package)" in str(caught.value) and "second (other_package)" in str(caught.value)
    assert plugins.load_hand("barrett").name == "barrett"
    assert [p.distribution for p in registry.installed("hand") if p.name == "twice"] == ["first", "second"]


def test_the_same_entry_point_found_twice_is_one(register):
    same = entry("hand", "theirs", "dexgrasp_theirs")
    register(same, same)
    assert registry.find("hand", "theirs") == same


def test_a_hand_is_a_package_with_yaml_and_urdf(register, package):
    package(
        "dexgrasp_theirs",
        {
            "__init__.py": "raise RuntimeError('a hand package is never imported')\n",
            "conf/hand/theirs.yaml": HAND_YAML.format(name="theirs", urdf="${package:dexgrasp_theirs}/theirs.urdf"),
            "conf/hand/theirs_wide.yaml": "defaults: [theirs]\nname: theirs\nshared: [left_joint]\n",
            "theirs.urdf": HAND_URDF,
        },
    )
    register(entry("hand", "theirs", "dexgrasp_theirs"))
    hand = plugins.load_hand("theirs")
    assert isinstance(hand, Hand) and hand.name == "theirs" and hand.joint_names == ("left_joint", "right_joint")
    wide = plugins.load_hand("theirs_wide")
    assert wide.fingers[1].main == ("left_joint", "right_joint"), "a variant: a YAML of another name"
    assert "dexgrasp_theirs" not in sys.modules


def test_a_hand_package_without_its_yaml_says_so(register, package):
    package("dexgrasp_theirs", {"__init__.py": ""})
    register(entry("hand", "theirs", "dexgrasp_theirs"))
    with pytest.raises(DexgraspError, match=r"conf/hand/theirs.yaml"):
        plugins.load_hand("theirs")


def test_a_hand_in_a_plain_folder_loads_by_path(tmp_path):
    (tmp_path / "pincer.urdf").write_text(HAND_URDF)
    path = tmp_path / "pincer.yaml"
    path.write_text(HAND_YAML.format(name="pincer", urdf="pincer.urdf"))
    assert plugins.load_hand(str(path)).name == "pincer"
    path.write_text("urdf: pincer.urdf\n")
    with pytest.raises(DexgraspError, match="`name`"):
        plugins.load_hand(str(path))
    path.write_text("name: [unclosed\n")
    with pytest.raises(DexgraspError, match="readable YAML"):
        plugins.load_hand(str(path))
    with pytest.raises(DexgraspError, match="no file"):
        plugins.load_hand(str(tmp_path / "none.yaml"))


def test_strange_and_missing_options_are_named():
    with pytest.raises(DexgraspError, match="did you mean 'head'"):
        plugins.load_backbone("pointnet", haed=[8])
    with pytest.raises(DexgraspError, match="no urdf"):
        plugins.build_hand({"name": "barrett", "fingers": []})
    with pytest.raises(DexgraspError, match="`name`"):
        plugins.build_backbone({"points": 3})


def test_missing_packages_are_named_by_the_resolver(tmp_path):
    path = tmp_path / "pincer.yaml"
    path.write_text(HAND_YAML.format(name="pincer", urdf="${package:dexgrasp_nowhere}/x.urdf"))
    with pytest.raises(DexgraspError, match="dexgrasp_nowhere"):
        plugins.load_hand(str(path))


def test_packages_are_found_without_importing(package):
    folder = package(
        "dexgrasp_theirs", {"__init__.py": "raise RuntimeError\n", "sub/__init__.py": "raise RuntimeError\n"}
    )
    assert registry.package_folder("dexgrasp_theirs") == folder
    assert registry.package_folder("dexgrasp_theirs.sub") == folder / "sub"
    assert registry.package_folder("dexgrasp_nowhere") is None and registry.package_folder("dexgrasp_theirs.no") is None


def test_our_configs_come_before_a_strangers(register, package):
    package("aaa_theirs", {"__init__.py": "", "conf/hand/barrett.yaml": "name: barrett\nurdf: nowhere\n"})
    register(entry("hand", "theirs", "aaa_theirs"))
    found = [name for name, _ in registry.conf_folders()]
    assert found[-1] == "aaa_theirs" and len(found) == len(set(found))


def test_the_one_exception_survives_a_worker():
    error = pickle.loads(pickle.dumps(DexgraspError("a", "b", "c")))
    assert (error.expected, error.found, error.remedy) == ("a", "b", "c")
