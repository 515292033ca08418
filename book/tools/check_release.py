"""Check that a tag, the version, the citation and the list of changes name the same release, and print its changes.

    python3 book/tools/check_release.py v0.1.0

Needs no package, so that a wrong release stops before anything is installed.
"""

import argparse
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
UNRELEASED = "not released yet"


def changes(root: Path, tag: str) -> str:
    """Return what CHANGELOG.md says about the release with this tag.

    Raises:
        ValueError: a file names another version, or the release is described as not made; the message names the file.
    """
    version = tomllib.loads(_text(root, "pyproject.toml"))["project"]["version"]
    if tag != f"v{version}":
        raise ValueError(f"the tag is {tag}, but pyproject.toml has the version {version}: tag v{version}")
    cited = dict(re.findall(r"^(version|date-released): *['\"]?([^'\"\n]+)", _text(root, "CITATION.cff"), re.MULTILINE))
    if cited.get("version") != version:
        raise ValueError(f"CITATION.cff has the version {cited.get('version')}, and pyproject.toml {version}")
    if "date-released" not in cited:
        raise ValueError("CITATION.cff has no date-released: add the day of the release")
    heading = rf"^## {re.escape(version)}(?![.\d])([^\n]*)\n"
    section = re.search(rf"{heading}(.*?)(?=^## |\Z)", _text(root, "CHANGELOG.md"), re.MULTILINE | re.DOTALL)
    if not section or UNRELEASED in section[1]:
        raise ValueError(f"CHANGELOG.md has no section on {version}, or calls it {UNRELEASED!r}")
    return section[2].strip()


def _text(root: Path, name: str) -> str:
    return (root / name).read_text(encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    """Check the release and print its changes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tag", help="such as v0.1.0")
    try:
        print(changes(ROOT, parser.parse_args(argv).tag))
    except (ValueError, OSError) as error:
        print(f"check_release: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
