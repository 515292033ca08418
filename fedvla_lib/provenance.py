"""Provenance of a result: digests of code and settings, and a stamp with commit, versions and hardware."""

import ast
import hashlib
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil

from fedvla_lib.config import Config

PACKAGES = ("fedvla-lib", "lerobot", "flwr", "torch", "transformers", "mujoco", "numpy")
LIBRARY = Path(__file__).parent
UNDECISIVE = ("out", "num_threads", "resume", "node_keys", "keep_last", "keep_every")  # settings that no result shows


def code_digest(function: Callable[..., Any]) -> str:
    """Return a short hash of what the code reached from `function` does.

    It covers all statements of all library modules that the function's module imports, directly or indirectly. Imports,
    comments, docstrings and the place of a statement do not count, so moving code does not change it. Names of cached
    results contain it, so that results of older code are not reused.
    """
    modules = reached_modules(function.__module__)
    statements = sorted(statement for module in modules for statement in _statements(module))
    return hashlib.sha256("\n".join(statements).encode()).hexdigest()[:12]


@cache
def reached_modules(module: str) -> frozenset[str]:
    """Return a library module and all library modules it imports, directly or indirectly, also inside functions."""
    reached, todo = set(), {module}
    while todo:
        reached.add(name := todo.pop())
        todo |= _imported(name) - reached
    return frozenset(reached)


def _tree(module: str) -> ast.Module:
    return ast.parse(_file(module).read_text(encoding="utf-8"))


def _file(module: str) -> Path:
    path = LIBRARY.parent / Path(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(module: str) -> set[str]:
    """The library modules and packages named in the import statements of `module`."""
    froms = [node for node in ast.walk(_tree(module)) if isinstance(node, ast.ImportFrom) and node.module]
    names = {f"{node.module}.{alias.name}" for node in froms for alias in node.names} | {node.module for node in froms}
    return {name for name in names if name.startswith(f"{LIBRARY.name}.") and _file(name).is_file()}


@cache
def _statements(module: str) -> tuple[str, ...]:
    """The statements of a module as normalised source text."""
    return tuple(ast.unparse(statement) for statement in _WithoutText().visit(_tree(module)).body)


class _WithoutText(ast.NodeTransformer):
    """Removes imports, docstrings and other bare strings; the parser has already dropped the comments."""

    visit_Import = visit_ImportFrom = lambda self, node: None

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else self.generic_visit(node)


def deciding(config: Config) -> dict[str, Any]:
    """Return the settings that decide a run's results: all but `UNDECISIVE`."""
    return {k: v for k, v in asdict(config).items() if k not in UNDECISIVE}


def config_hash(config: Config) -> str:
    """Return a short hash of the settings that decide a run's results."""
    return hashlib.sha256(json.dumps(deciding(config), sort_keys=True).encode()).hexdigest()[:12]


def first_stamp(config: Config, engine: str) -> dict[str, Any]:
    """Return the stamp of a run that starts: commit, hash of the settings, versions, hardware."""
    return {
        "status": "running", "engine": engine, "started": now(), "wall_s": None, "commit": _commit(),
        "config_hash": config_hash(config), "seed": config.seed, "python": platform.python_version(),
        "versions": {name: version_of(name) for name in PACKAGES},
        "hardware": {
            "machine": platform.machine(), "system": platform.system(), "cores": os.cpu_count(),
            "device": config.device, "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        },
    }  # fmt: skip


def version_of(package: str) -> str | None:
    """Return the version of an installed package; None for this library in a Flower app bundle."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of this library's checkout, with + if tracked files were changed; None outside a checkout."""
    if shutil.which("git") is None:
        return None
    command = ["git", "describe", "--always", "--exclude=*", "--abbrev=40", "--dirty=+"]
    return subprocess.run(command, cwd=LIBRARY, capture_output=True, text=True).stdout.strip() or None


def now() -> str:
    """Return the local time with its offset from UTC, in ISO 8601 format to the millisecond."""
    return datetime.now().astimezone().isoformat(timespec="milliseconds")
