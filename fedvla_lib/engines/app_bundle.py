"""The Flower app as a folder with a project file, which holds the settings of a run."""

import json
import re
import shutil
import sys
from pathlib import Path

from fedvla_lib import provenance
from fedvla_lib.config import Config, to_run_config
from fedvla_lib.federation.strategies import build

PACKAGE = Path(__file__).resolve().parents[1]
PROJECT = "fedvla-lib"  # name in pyproject.toml and of the installed package


def stage_app(folder: Path, config: Config) -> Path:
    """Copy the Flower app into ``folder/app`` and return that, since `flwr` would search the whole checkout.

    Its pyproject.toml is minimal, since a library installed from a wheel has none: name, the two apps, the settings of
    the run and the files to bundle.
    """
    package = PACKAGE
    app = folder / "app"
    shutil.copytree(package, app / package.name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    release = provenance.version_of(PROJECT) or "0"  # the library may have been copied, not installed
    files = [f"{package.name}/**/*.py", *_add_strategy(config, app)]
    tables = {
        "project": {"name": PROJECT, "version": release, "description": "", "license": "Apache-2.0"},
        "tool.flwr.app": {"publisher": "fedvla", "fab-include": files},
        "tool.flwr.app.components": {
            "serverapp": f"{package.name}.federation.server_app:app",
            "clientapp": f"{package.name}.federation.client_app:app",
        },
        "tool.flwr.app.config": to_run_config(config),
    }
    lines = []
    for name, values in tables.items():  # JSON scalars and lists of scalars are valid TOML
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items())]
    (app / "pyproject.toml").write_text("\n".join(lines) + "\n")
    return app


def _add_strategy(config: Config, app: Path) -> list[str]:
    """Copy the module of a strategy that is in the working directory to the app; return patterns for the bundle.

    Elsewhere the server finds it as this process does: what is installed, or on the PYTHONPATH.

    Raises:
        ValueError: the settings name a strategy that is none.
    """
    if ":" not in config.strategy:
        return []
    build.brought(config.strategy)
    name, here = re.split("[.:]", config.strategy)[0], Path.cwd()
    file = Path(sys.modules[name].__file__ or "").resolve()
    if name == PACKAGE.name or file.parent not in (here, here / name):
        return []
    if file.parent == here:
        return [shutil.copy(file, app / file.name).name]
    shutil.copytree(file.parent, app / name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    return [f"{name}/**/*.py"]
