"""What must hold of the files themselves, whatever the code does."""

import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from fedvla_lib.cli.parser import build_parser

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parent.parent
SUFFIXES = {".py", ".md", ".toml", ".yml", ".bib", ".ipynb", ".lock", ".css", ".svg", ""}
# Written in halves, so that this file does not contain what it looks for.
REGISTRY_HOSTS = ["pyp" + "i.org", "pythonho" + "sted.org", "files.py" + "pi", "index-" + "url", "deb.deb" + "ian"]
MACHINE_FOLDERS = ["ho" + "me", "ro" + "ot", "wo" + "rk", "Us" + "ers"]
MACHINE_PATH = re.compile(rf"(?<![A-Za-z0-9_.$}}])/(?:{'|'.join(MACHINE_FOLDERS)})/")


def tracked_files() -> list[Path]:
    """Files that git tracks or would track, as text."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [ROOT / name for name in names if Path(name).suffix in SUFFIXES and (ROOT / name).is_file()]


def pins() -> list[Requirement]:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    return [Requirement(line.rstrip("\\ ")) for line in lines if "==" in line]


def declared() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    return [Requirement(line) for line in project["dependencies"] + extras]


def test_no_registry_host_and_no_machine_path():
    found = []
    for path in tracked_files():
        text = path.read_text(encoding="utf-8")
        found += [f"{path.relative_to(ROOT)}: {host}" for host in REGISTRY_HOSTS if host in text]
        found += [f"{path.relative_to(ROOT)}: {match[0]}" for match in MACHINE_PATH.finditer(text)]
    assert not found


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-uv.lock"])
def test_every_pin_has_hashes(name):
    blocks = re.split(r"^(?=[a-z0-9])", (ROOT / name).read_text(), flags=re.MULTILINE)[1:]
    assert blocks
    bare = [block.split()[0] for block in blocks if "--hash=sha256:" not in block]
    assert not bare


def test_lock_satisfies_the_declared_ranges():
    versions = {}
    for pin in pins():
        versions.setdefault(canonicalize_name(pin.name), []).append(str(next(iter(pin.specifier)).version))
    for wanted in declared():
        locked = versions.get(canonicalize_name(wanted.name), [])
        assert locked, f"{wanted} is not in requirements.lock: run make lock"
        assert all(wanted.specifier.contains(version) for version in locked), f"{wanted}: locked is {locked}"


def test_readme_commands_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    for page in ["README.md", "CONTRIBUTING.md", *(f"book/{name}.md" for name in ("index", "setup", "how_to_read"))]:
        used = set(re.findall(r"(?:^|[`\s])make ([a-z-]+)", code_of(page), flags=re.MULTILINE))
        assert used <= targets, f"{page} names {sorted(used - targets)}"


def shell_lines() -> list[tuple[str, list[str]]]:
    """What the pages tell readers to type: the page, and the words of each line."""
    found = []
    for page in ["README.md", "CONTRIBUTING.md", *(f"book/{path.name}" for path in (ROOT / "book").glob("*.md"))]:
        blocks = re.findall(r"^```bash\n(.*?)^```", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)
        lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
        found += [(page, words) for line in lines if (words := shlex.split(line, comments=True))]
    return found


def test_every_fedvla_command_of_a_page_parses():
    calls = [(page, words) for page, words in shell_lines() if Path(words[0]).name == "fedvla"]
    assert {"README.md", "book/deployment.md", "book/how_to_read.md"} <= {page for page, _ in calls}
    for page, (_, *words) in calls:
        told = words[: words.index(">")] if ">" in words else words
        try:
            build_parser().parse_args(told)
        except SystemExit as ended:
            assert ended.code == 0, f"{page}: fedvla {' '.join(told)}"  # --help


def test_every_script_that_a_page_names_is_there():
    scripts = {words[1] for _, words in shell_lines() if Path(words[0]).name == "python"}
    assert scripts and not [name for name in scripts if not (ROOT / name).is_file()]


def test_every_page_of_the_book_is_linked_from_another():
    """Not only from the list of contents; the bibliography is linked by what cites it."""
    texts = {path.stem: path.read_text() for path in (ROOT / "book").glob("*.md")}
    texts |= {path.stem: path.read_text() for path in (ROOT / "notebooks").glob("*.ipynb")}
    links = ((page, name) for page, text in texts.items() for name in re.findall(r"\{doc\}`([^`]+)`", text))
    linked = {target for page, name in links if (target := name.split("/")[-1].strip("<>")) != page}
    assert set(texts) - linked == {"index", "bibliography"}


def code_of(page: str) -> str:
    """Text in code blocks and in backticks."""
    text = (ROOT / page).read_text()
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return "\n".join([*blocks, *re.findall(r"`([^`\n]+)`", text)])


def test_bibliography_holds_what_is_cited_and_nothing_else():
    entries = set(re.findall(r"^@\w+\{([^,]+),", (ROOT / "book" / "references.bib").read_text(), flags=re.MULTILINE))
    texts = [path.read_text() for path in [*(ROOT / "book").glob("*.md"), *(ROOT / "notebooks").glob("*.ipynb")]]
    lists = [names for text in texts for names in re.findall(r"\{cite(?::\w+)?\}`([^`]+)`", text)]
    cited = {name.strip() for names in lists for name in names.split(",")}
    assert cited == entries


def test_licence_is_whole():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text and "END OF TERMS AND CONDITIONS" in text
