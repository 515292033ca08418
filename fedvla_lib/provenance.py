"""Where a result comes from: the code, settings, versions and hardware that made it."""

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

from fedvla_lib.config import Config

PACKAGES = ("fedvla-lib", "lerobot", "flwr", "torch", "transformers", "mujoco", "numpy")
LIBRARY = Path(__file__).parent


def code_digest(*functions: Callable[..., Any]) -> str:
    """Return a short hash of what the code that these functions reach does.

    It covers every statement of every module of the library that theirs import, directly or through others. Imports,
    comments and docstrings do not count, nor where a statement stands: code that only moves keeps its digest. What is
    kept in the cache carries the digest in its name, so that results of older code do not pass for results of this.
    """
    modules = {module for function in functions for module in reached_modules(function.__module__)}
    statements = sorted(statement for module in modules for statement in _statements(module))
    return hashlib.sha256("\n".join(statements).encode()).hexdigest()[:12]


@cache
def reached_modules(module: str) -> frozenset[str]:
    """Return a module of the library and all that it imports, at its top or inside functions, directly or not."""
    found, todo = set(), {module}
    while todo:
        found.add(name := todo.pop())
        todo |= _imported(name) - found
    return frozenset(found)


def _tree(module: str) -> ast.Module:
    return ast.parse(_file(module).read_text(encoding="utf-8"))


def _file(module: str) -> Path:
    path = LIBRARY.parent / Path(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(module: str) -> set[str]:
    """The library's modules that a module names in an import statement; the import of a package is one of these too."""
    froms = [node for node in ast.walk(_tree(module)) if isinstance(node, ast.ImportFrom) and node.module]
    names = {f"{node.module}.{alias.name}" for node in froms for alias in node.names} | {node.module for node in froms}
    return {name for name in names if name.startswith(f"{LIBRARY.name}.") and _file(name).is_file()}


@cache
def _statements(module: str) -> tuple[str, ...]:
    """The statements of a module as text that depends on what they do only."""
    return tuple(ast.unparse(statement) for statement in _WithoutWords().visit(_tree(module)).body)


class _WithoutWords(ast.NodeTransformer):
    """Drops what does not act: imports, docstrings and other bare texts. Comments are not in a tree at all."""

    def visit_Import(self, node: ast.Import) -> None:
        return None

    visit_ImportFrom = visit_Import

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else self.generic_visit(node)


def config_hash(config: Config) -> str:
    """Return a short hash of what a run computes: all settings except where it writes and how many threads it uses."""
    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "num_threads", "resume")}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def first_stamp(config: Config, engine: str) -> dict[str, Any]:
    """Return what is known of a run when it starts: commit, settings, versions, hardware."""
    return {
        "status": "running",
        "engine": engine,
        "started": now(),
        "wall_s": None,
        "commit": _commit(),
        "config_hash": config_hash(config),
        "seed": config.seed,
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "hardware": _hardware(config),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None  # inside a Flower app bundle this library runs without being installed


def _hardware(config: Config) -> dict[str, Any]:
    return {
        "machine": platform.machine(),
        "system": platform.system(),
        "cores": os.cpu_count(),
        "device": config.device,
        "memory_gb": _memory_gb(),
    }


def _memory_gb() -> float | None:
    if not hasattr(os, "sysconf"):
        return None
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)


def _commit() -> str | None:
    """The commit of the checkout this library lies in, with + when tracked files differ; None outside a checkout."""
    if shutil.which("git") is None:
        return None
    here = Path(__file__).parent
    command = ["git", "describe", "--always", "--exclude=*", "--abbrev=40", "--dirty=+"]
    described = subprocess.run(command, cwd=here, capture_output=True, text=True)
    return described.stdout.strip() or None


def now() -> str:
    return datetime.now().astimezone().isoformat(timespec="milliseconds")
