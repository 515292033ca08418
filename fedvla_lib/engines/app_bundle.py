"""The app as Flower's programs take it: a folder with a project file, and the settings of a run."""

import json
import shutil
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, to_run_config

PROJECT = "fedvla-lib"  # as pyproject.toml and the installed package name it


def stage_app(folder: Path) -> Path:
    """Copy what the Flower app needs into ``folder/app`` and return it: `flwr` would search the whole checkout.

    A library that was installed from its wheel has no project file beside it; the app then gets one of its own.
    """
    package = Path(__file__).resolve().parents[1]
    app = folder / "app"
    shutil.copytree(package, app / package.name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    if _is_checkout(package.parent):
        for name in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(package.parent / name, app / name)
    else:
        (app / "pyproject.toml").write_text(_project_file(package.name))
    return app


def _is_checkout(folder: Path) -> bool:
    """Whether this is the project's own folder: a stranger's pyproject.toml may lie in site-packages."""
    project = folder / "pyproject.toml"
    return project.is_file() and tomllib.loads(project.read_text()).get("project", {}).get("name") == PROJECT


def _project_file(package: str) -> str:
    """Return the least that `flwr` takes as a project: a name, the two apps, the settings and what to bundle."""
    try:
        release = version(PROJECT)
    except PackageNotFoundError:  # a copied folder
        release = "0"
    tables = {
        "project": {"name": PROJECT, "version": release, "description": "", "license": "Apache-2.0"},
        "tool.flwr.app": {"publisher": "fedvla", "fab-include": [f"{package}/**/*.py"]},
        "tool.flwr.app.components": {
            "serverapp": f"{package}.federation.server_app:app", "clientapp": f"{package}.federation.client_app:app",
        },
        "tool.flwr.app.config": to_run_config(Config()),
    }  # fmt: skip
    return "\n".join(f"[{name}]\n{_toml(values)}" for name, values in tables.items())


def write_settings(folder: Path, config: Config) -> Path:
    """Write ``folder/settings.toml`` for ``--run-config`` and return it."""
    path = folder / "settings.toml"
    path.write_text(_toml(to_run_config(config)))
    return path


def _toml(values: dict[str, Any]) -> str:
    """Return the lines of a table: JSON's scalars and lists of them are TOML's."""
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())
