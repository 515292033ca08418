"""The Flower app as a folder with a project file, and the settings of a run as a TOML file."""

import json
import shutil
from pathlib import Path
from typing import Any

from fedvla_lib import provenance
from fedvla_lib.config import Config, to_run_config

PROJECT = "fedvla-lib"  # name in pyproject.toml and of the installed package


def stage_app(folder: Path) -> Path:
    """Copy the Flower app into ``folder/app`` and return that, since `flwr` would search the whole checkout.

    Its pyproject.toml is minimal, since a library installed from a wheel has none: name, the two apps, the settings and
    the files to bundle.
    """
    package = Path(__file__).resolve().parents[1]
    app = folder / "app"
    shutil.copytree(package, app / package.name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    release = provenance.version_of(PROJECT) or "0"  # the library may have been copied, not installed
    tables = {
        "project": {"name": PROJECT, "version": release, "description": "", "license": "Apache-2.0"},
        "tool.flwr.app": {"publisher": "fedvla", "fab-include": [f"{package.name}/**/*.py"]},
        "tool.flwr.app.components": {
            "serverapp": f"{package.name}.federation.server_app:app",
            "clientapp": f"{package.name}.federation.client_app:app",
        },
        "tool.flwr.app.config": to_run_config(Config()),
    }
    project = "\n".join(f"[{name}]\n{_toml(values)}" for name, values in tables.items())
    (app / "pyproject.toml").write_text(project)
    return app


def write_settings(folder: Path, config: Config) -> Path:
    """Write ``folder/settings.toml``, a file for ``--run-config``, and return its path."""
    path = folder / "settings.toml"
    path.write_text(_toml(to_run_config(config)))
    return path


def _toml(values: dict[str, Any]) -> str:
    """Return the lines of a TOML table; JSON scalars and lists of scalars are valid TOML."""
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())
