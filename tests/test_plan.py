"""The plan of the house: no import circles, no arrow from the core to a plugin, one noun a module."""

import ast
from pathlib import Path

import pytest
import torch
from jaxtyping import TypeCheckError

ROOT = Path(__file__).resolve().parents[1]
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "dexgrasp").rglob("*.py"))
}
PLUGINS = {path.name: path for path in sorted((ROOT / "plugins").glob("*/*/dexgrasp_*")) if path.is_dir()}


def top_level(tree):
    """Imports that run when the module is imported: not those within functions or under TYPE_CHECKING."""
    for node in tree.body if hasattr(tree, "body") else []:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.Try | ast.With | ast.ClassDef | ast.If) and "TYPE_CHECKING" not in ast.unparse(node):
            yield from top_level(node)


def imported(nodes, module=""):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import on line {node.lineno}"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield whole if whole in MODULES else str(node.module)


def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def edges():
    graph = {}
    for module, path in MODULES.items():
        found = set(imported(top_level(parsed(path)), module))
        graph[module] = sorted(name for name in found if name in MODULES and name != module)
    return graph


def test_there_are_modules_and_plugins():
    assert "dexgrasp.hand" in MODULES and "dexgrasp_barrett" in PLUGINS


def test_imports_have_no_circle():
    graph, done = edges(), set()

    def visit(module, path):
        assert module not in path, "import circle: " + " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            for other in graph[module]:
                visit(other, [*path, module])
            done.add(module)

    for module in graph:
        visit(module, [])


@pytest.mark.parametrize("module", MODULES)
def test_the_core_imports_no_plugin(module):
    names = imported(
        (n for n in ast.walk(parsed(MODULES[module])) if isinstance(n, ast.Import | ast.ImportFrom)), module
    )
    assert not {name for name in names if name.split(".")[0] in PLUGINS}
    text = MODULES[module].read_text(encoding="utf-8")
    assert not [name for name in PLUGINS if f'"{name}' in text], "an import path of a plugin as text"


@pytest.mark.parametrize("plugin", PLUGINS)
def test_plugins_import_the_core_and_themselves_only(plugin):
    for path in PLUGINS[plugin].rglob("*.py"):
        nodes = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Import | ast.ImportFrom)]
        others = {name.split(".")[0] for name in imported(nodes, str(path))} & (set(PLUGINS) - {plugin})
        assert not others, f"{path} imports {others}"


def test_the_floors_of_the_house():
    """Data know no behaviour, commands are known by nothing."""
    graph = edges()
    data = {"batch", "geometry", "grasps", "scene", "errors", "seeds"}
    for module in data:
        above = {name.removeprefix("dexgrasp.") for name in graph[f"dexgrasp.{module}"]} - data
        assert not above, f"dexgrasp.{module} imports {above}"
    for module, others in graph.items():
        if not module.startswith("dexgrasp.commands"):
            assert not [name for name in others if name.startswith("dexgrasp.commands.")], module


def test_no_module_is_called_utils():
    names = {name.rpartition(".")[2] for name in MODULES} | {p.stem for f in PLUGINS.values() for p in f.rglob("*.py")}
    assert not names & {"utils", "util", "helpers", "common", "misc"}


def test_no_robot_is_known_by_name():
    """`if hand.name == ...` is how a hand-agnostic house falls down."""
    for module, path in MODULES.items():
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Compare):
                compared = ast.unparse(node)
                assert not any(f"'{name}'" in compared for name in ("barrett", "allegro", "shadow")), (
                    f"{module}: {compared}"
                )


def test_shapes_in_signatures_are_checked_under_pytest():
    from dexgrasp.geometry import pose

    with pytest.raises(TypeCheckError):
        pose(torch.eye(3), torch.zeros(4))
    assert pose(torch.eye(3), torch.zeros(3)).shape == (4, 4)
