"""Import rules: the order of the packages, which of them may use which heavy dependency, and no circles."""

import ast
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import library
from fedvla_lib.config import Config, to_run_config

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
MODULES = library.modules(ROOT)  # raises if there is none


def parsed(*folders: str) -> dict[str, ast.Module]:
    """Files below folders of the repository, by their path: two may share a name."""
    files = sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py"))
    return {file.relative_to(ROOT).as_posix(): ast.parse(file.read_text()) for file in files}


BOOK = parsed("book/fedvla_book")
# A package may import itself and what stands before it.
ORDER = (
    library.ROOT_FILES, "robot", "data", "policy", "evaluation", "federation", "pretraining", "engines", "experiments",
    "cli",
)  # fmt: skip
ROOT_ORDER = ("config", "files", "provenance", "run_folder", "workers")
APART = {"pretraining": {"federation"}}  # before it in the list, and still not its business
STRATEGIES = "federation.strategies"

# Heavy dependency -> packages or modules that may import it, anywhere but in commands, which import when they run.
FENCES = {
    "mujoco": {"robot.rendering", "robot.scene", "robot.sim"},
    "mink": {"robot.expert"},
    "gymnasium": {"robot.lerobot_env", "robot.sim"},
    "torch": {
        "policy.actor", "policy.gradient_checkpoints", "policy.lean_expert", "policy.lora", "policy.model",
        "policy.optimizers", "policy.parameters", "policy.prefix_cache", "policy.training",
        "data.augmentation", "data.batches", "data.frame_store", "evaluation.diagnosis", "evaluation.held_out",
        "pretraining.grounding",
        f"{STRATEGIES}.fedprox", f"{STRATEGIES}.scaffold",
    },
    "lerobot": {
        "robot.lerobot_env", "robot.lerobot_robot", "robot.lerobot_teleoperator", "robot.config_lerobot_robot",
        "robot.config_lerobot_teleoperator", "data.conversion", "data.episode_writer", "data.frame_store",
        "data.lerobot_reader", "data.normalisation",
        "policy.lean_expert", "policy.model", "policy.prefix_cache", "policy.training",
    },
    "transformers": {"policy.prefix_cache"},
    "flwr": {
        "federation.client_app", "federation.messages", "federation.nodes", "federation.rollout_replies",
        "federation.server_app",
        "federation.secure_aggregation", "federation.secure_round", "federation.throttled_grid", STRATEGIES,
        "engines.inline",
    },
    "dp_accounting": {"federation.accountant"},
    "flwr_datasets": {"data.partition"},
    "matplotlib": {"evaluation.figures"},
    "ray": set(),
}  # fmt: skip
BOOK_FENCES = {  # the same for the book's package; the type of a policy counts as an import
    "torch": {"full_size.py", "attacks/reconstruction.py"},
    "lerobot": {"full_size.py", "tables/model.py"},
    "flwr": {"attacks/hostile.py"},
    "matplotlib": {f"plots/{name}.py" for name in (
        "clients", "comparisons", "episodes", "style", "success_rates", "training")},
}  # fmt: skip


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
    inside = {one.removeprefix("fedvla_lib.") for one in imports(MODULES[name]) if one.startswith("fedvla_lib.")}
    return {part for one in inside for part in (one, one.rpartition(".")[0]) if part in MODULES}


def users_of(package: str, trees: dict[str, ast.Module]) -> set[str]:
    return {name for name, tree in trees.items() if package in {one.split(".")[0] for one in imports(tree)}}


def stands_in(name: str, places: set[str]) -> bool:
    return any(f"{name}.".startswith(f"{place}.") for place in places)


def upward(names, imported) -> list[tuple[str, str]]:
    """Imports that go against the order of packages, or into a package that is not the importer's business."""
    found = []
    for name in names:
        for other in imported(name):
            room, used = library.room_of(name), library.room_of(other)
            if ORDER.index(used) > ORDER.index(room) or used in APART.get(room, ()):
                found.append((name, other))
    return found


def test_there_are_modules_in_every_room():
    assert {library.room_of(name) for name in MODULES} == set(ORDER)
    assert {name for name in MODULES if library.room_of(name) == library.ROOT_FILES} == set(ROOT_ORDER)
    assert len(MODULES) > 60 and f"{STRATEGIES}.scaffold" in MODULES


def test_a_folder_without_modules_is_an_error(tmp_path):
    (tmp_path / "fedvla_lib").mkdir()
    with pytest.raises(ValueError, match="holds no module"):
        library.modules(tmp_path)


def test_rooms_import_in_one_direction():
    assert not upward(MODULES, ours)


def test_an_import_against_the_order_is_found():
    turned = {"robot.sim": {"cli.doctor"}, "pretraining.pretrain": {"federation.client"}, "data.record": {"robot.sim"}}
    found = upward(turned, turned.__getitem__)
    assert found == [("robot.sim", "cli.doctor"), ("pretraining.pretrain", "federation.client")]


def test_no_module_imports_itself_through_others():
    order = list(TopologicalSorter({name: ours(name) for name in MODULES}).static_order())
    assert order.index("robot.spec") < order.index("engines.inline") and not ours("robot.spec")
    for place, name in enumerate(ROOT_ORDER):
        assert ours(name) <= set(ROOT_ORDER[:place])


@pytest.mark.parametrize("package", FENCES)
def test_heavy_packages_stay_behind_their_fence(package):
    users = {name for name in users_of(package, MODULES) if library.room_of(name) != "cli"}
    assert [name for name in users if not stands_in(name, FENCES[package])] == []
    idle = [place for place in FENCES[package] if not any(stands_in(name, {place}) for name in users)]
    assert not idle, f"does not import {package}: the fence guards nothing"


@pytest.mark.parametrize("package", FENCES)
def test_heavy_packages_stay_behind_their_fence_in_the_book(package):
    wanted = {f"book/fedvla_book/{name}" for name in BOOK_FENCES.get(package, ())}
    assert users_of(package, BOOK) == wanted


def test_only_the_engines_import_the_apps():
    apps = {"federation.client_app", "federation.server_app"}
    assert {name for name in MODULES if ours(name) & apps} == {"engines.inline"}


def test_a_package_holds_a_paragraph_and_no_imports():
    """Else asking for one module loads a whole package: `fedvla --help` would load torch."""
    for file in (ROOT / "fedvla_lib").rglob("*/__init__.py"):
        tree = ast.parse(file.read_text())
        assert len(tree.body) == 1, file
        text = ast.get_docstring(tree)
        assert "May import" in text and "Start reading" in text, file


def test_help_loads_neither_torch_nor_flower():
    code = (
        "import contextlib, sys\nfrom fedvla_lib.cli.main import main\n"
        "with contextlib.suppress(SystemExit): main(['run', '--help'])\n"
        "sys.exit(' '.join(sorted({'torch', 'flwr', 'lerobot', 'mujoco', 'ray'} & set(sys.modules))) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and "--num-clients" in done.stdout, done.stderr


def test_exercises_are_light_and_the_library_does_not_know_the_book():
    """A reader's answer is checked at once; the library does not depend on what chapters ask."""
    own = parsed("book/fedvla_book/exercises")
    assert own and not [n for n, tree in own.items() if {i.split(".")[0] for i in imports(tree)} & set(FENCES)]
    assert not [name for name, tree in MODULES.items() if any("fedvla_book" in i for i in imports(tree))]


def test_nothing_can_load_a_pickle():
    """Weights are safetensors; whoever imports one of these could run what a stranger sent.

    `workers` reads what its own parent process wrote to its pipe, as Python's pools of processes do.
    """
    everything = MODULES | BOOK
    loaders = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
    users = {name for name, tree in everything.items() if {i.split(".")[0] for i in imports(tree)} & loaders}
    assert users == {"workers"}
    words = ("torch.load", "read_pickle", "allow_pickle=True")
    assert not {name for name, tree in everything.items() if any(word in ast.unparse(tree) for word in words)}


def test_no_text_is_run_as_code_or_by_a_shell():
    """A name of a file, a host or a task may come from a stranger: lists of arguments are not parsed again."""
    everything = MODULES | BOOK
    words = ("shell=True", "os.system", "os.popen")
    assert not {name for name, tree in everything.items() if any(word in ast.unparse(tree) for word in words)}
    calls = {(name, node.func.id) for name, tree in everything.items() for node in ast.walk(tree)
             if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}  # fmt: skip
    assert not {name for name, called in calls if called in ("eval", "exec")}


def test_there_is_no_drawer_for_odds_and_ends():
    assert not {"utils", "helpers", "common", "misc"} & {part for name in MODULES for part in name.split(".")}


def sizes():
    """Yield (what, size, limit) of every file and function of the library, the book's code and the benchmarks."""
    for name, tree in parsed("fedvla_lib", "book/fedvla_book", "book/tools", "benchmarks").items():
        yield name, len((ROOT / name).read_text().splitlines()), 350
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                arguments += [one for one in (node.args.vararg, node.args.kwarg) if one]
                count = len([one for one in arguments if one.arg not in ("self", "cls")])
                yield f"{name}.{node.name}", node.end_lineno - node.lineno + 1, 40
                yield f"parameters of {name}.{node.name}", count, 8


def test_files_and_functions_stay_small():
    assert [(what, size) for what, size, limit in sizes() if size > limit] == []


def test_the_library_stays_small():
    files = [*(ROOT / "fedvla_lib").rglob("*.py")]
    assert sum(len(file.read_text().splitlines()) for file in files) <= 13_400


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
