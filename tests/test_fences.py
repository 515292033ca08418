"""The house rules about imports: who may use which heavy package, and that imports run one way."""

import ast
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from fedvla_lib.config import Config, to_run_config

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
MODULES = {path.stem: ast.parse(path.read_text()) for path in (ROOT / "fedvla_lib").glob("*.py")}
TOP = {"doctor", "cli"}  # look at everything, from inside functions

APPS = {"client_app", "server_app"}
FENCES = {
    "mujoco": {"sim", "scene", "expert"},
    "mink": {"expert"},
    "torch": {"model", "params", "train", "prefix", "data", "ground", "corrections", "lora", "full_size"},
    "lerobot": {"model", "train", "prefix", "data", "source", "record", "lerobot_env", "full_size"},
    "flwr": {"wire", "roster", "grid", "strategies", "engine"} | APPS,
    "flwr_datasets": {"partition"},
    "matplotlib": {"plots"},
    "ray": set(),
}


def imports(tree: ast.AST) -> set[str]:
    """Every name that is imported, with its package, at the top of the module or inside a function."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def ours(name: str) -> set[str]:
    """The modules of ours that a module imports."""
    parts = [imported.split(".") for imported in imports(MODULES[name]) if imported.startswith("fedvla_lib.")]
    return {part[1] for part in parts if part[1] in MODULES}


@pytest.mark.parametrize("package", FENCES)
def test_heavy_packages_stay_behind_their_fence(package):
    users = {name for name, tree in MODULES.items() if any(i.split(".")[0] == package for i in imports(tree))}
    assert users - TOP <= FENCES[package]


def test_exercises_are_light_and_nothing_leans_on_them():
    """A reader's answer is checked at once; the library does not depend on what chapters ask."""
    own = {path.stem: ast.parse(path.read_text()) for path in (ROOT / "fedvla_lib" / "exercises").glob("*.py")}
    assert not [name for name, tree in own.items() if {i.split(".")[0] for i in imports(tree)} & set(FENCES)]
    assert not [name for name, tree in MODULES.items() if any("exercises" in i for i in imports(tree))]


def test_nothing_can_load_a_pickle():
    """Weights are safetensors; whoever imports one of these could run what a stranger sent."""
    loaders = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
    assert not {name for name, tree in MODULES.items() if {i.split(".")[0] for i in imports(tree)} & loaders}
    called = {name: ast.unparse(tree) for name, tree in MODULES.items()}
    words = ("torch.load", "read_pickle", "allow_pickle=True")
    assert not {name for name, code in called.items() if any(word in code for word in words)}


def test_imports_run_one_way():
    order = list(TopologicalSorter({name: ours(name) for name in MODULES}).static_order())
    assert order.index("spec") < order.index("engine")
    assert not ours("spec") and not ours("config")


def test_only_the_engine_imports_the_apps():
    assert {name for name in MODULES if ours(name) & APPS} == {"engine"}


def test_there_is_no_drawer_for_odds_and_ends():
    assert not {"utils", "helpers", "common", "misc"} & set(MODULES)


def test_the_flower_app_has_every_setting_with_its_default():
    app = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["flwr"]["app"]
    assert app["config"] == to_run_config(Config())
    assert [type(value) for value in app["config"].values()] == [type(v) for v in to_run_config(Config()).values()]
    assert app["components"] == {
        "serverapp": "fedvla_lib.federation.server_app:app",
        "clientapp": "fedvla_lib.federation.client_app:app",
    }


def test_no_connection_is_kept_where_flower_would_rewrite_the_file():
    assert "federations" not in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["flwr"]
