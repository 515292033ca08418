"""Run every command of the library at another commit and here, and say what differs.

    python book/tools/same_behaviour.py REVISION

For a change that must not change what the library does. Files, weights, events and rows are compared by value; what
commands print is compared line by line, with times, paths and sizes masked, and lines that differ are shown.
Exit status 0: values are the same, and only words may differ; 1: a value differs; 2: a command failed.
"""

import argparse
import csv
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from difflib import unified_diff
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLAN = """profile = "tiny"
seeds = [0]
rollouts = 3
[settings]
num_clients = 3
[partitions.task]
partition = "task"
""" + "".join(
    f'[METHODS.{kind}]\nkind = "{kind}"\n' for kind in ("base", "federated", "centralized", "local-only", "clients")
)
RUN = ["--profile", "tiny", "--seed", "3"]
COMMANDS = {  # name -> arguments; {D} is a folder for this command, {X} the folder of command X
    "record": ["record", "--profile", "tiny", "--task", "lift", "--episodes", "3", "--out", "{D}/data"],
    "inline": ["run", *RUN, "--out", "{D}"],
    "simulation": ["run", *RUN, "--engine", "simulation", "--out", "{D}"],
    "deployment": ["deploy", *RUN, "--tls", "--auth", "--out", "{D}"],
    "scaffold": ["run", *RUN, "--strategy", "scaffold", "--exchange", "int8", "--keep-optimizer", "--out", "{D}"],
    "other": ["run", "--profile", "tiny", "--seed", "3", "--lr", "0.002", "--out", "{D}"],
    "train": ["train", *RUN, "--steps", "4", "--out", "{D}"],
    "client": ["train", *RUN, "--client", "1", "--steps", "2", "--out", "{D}"],
    "evaluate": ["evaluate", "{inline}/*/global_model/round_2", "--rollouts", "2", "--out", "{D}"],
    "compare": ["compare", "{inline}/2*", "{other}/2*", "--out", "{D}"],
    "videos": ["videos", "{inline}/*/evaluate", "--out", "{D}"],
    "experiment": ["experiment", "{D}/plan.toml", "--out", "{D}/grid"],
    "experts": ["experts", "--task", "lift", "--episodes", "2"],
    "config": ["config", "--profile", "tiny"],
    "credentials": ["credentials", "--host", "server", "--nodes", "2", "--out", "{D}/keys"],
    "superlink": ["superlink", "status"],
    "doctor": ["doctor"],
    "wrong": ["run", "--profile", "tiny", "--partition", "alphabet"],
    "help": ["--help"],
}
HELPED = ("record", "pretrain", "experts", "config", "train", "run", "deploy", "superlink", "credentials", "evaluate",
          "experiment", "compare", "videos", "doctor")  # fmt: skip
COMMANDS |= {f"{name} --help": [name, "--help"] for name in HELPED}
MASKS = [
    (r"(?<!\d)\d{8}_\d{6}(_\d{6})?(?!\d)", "TIME"), (r"\b\d+(\.\d+)? (s|seconds|GiB|MB)\b", "N \\2"),
    (r"\d+%\|.*", "BAR"),
    (r"process \d+", "process N"), (r"127\.0\.0\.1:\d+", "ADDRESS"), (r" +", " "),
]  # fmt: skip
FLEETING = {
    "time",
    "seconds",
    "video",
    "wall_s",
    "train_s",
    "started",
    "commit",
    "code",
    "stamp",
    "bytes",
    "data",
    "out",
}


def behaviour(tree: Path, folder: Path) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Run all commands with the library in `tree`; return digests of values by name, and masked lines by command."""
    values, texts, places = {}, {}, {}
    for name, arguments in COMMANDS.items():
        places[name] = place = folder / name.replace(" ", "_")
        place.mkdir()
        key = "methods" if (tree / "fedvla_lib" / "robot").is_dir() else "arms"
        (place / "plan.toml").write_text(PLAN.replace("METHODS", key))
        filled = [_filled(argument, place, places) for argument in arguments]
        environment = {
            **os.environ, "PYTHONPATH": f"{tree}{os.pathsep}{tree / 'book'}", "FEDVLA_CACHE": str(folder / "cache"),
            "FLWR_HOME": str(folder / "flwr"), "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0", "COLUMNS": "120",
        }  # fmt: skip
        command = [sys.executable, "-m", "fedvla_lib.cli", *filled]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        print(f"{tree.name}: {name}, exit status {done.returncode}", file=sys.stderr, flush=True)
        shown = done.stdout + ("" if done.returncode == 0 else done.stderr)
        texts[name] = [f"exit status {done.returncode}", *_masked(shown, folder, tree).splitlines()]
        values |= {f"{name}/{part}": digest for part, digest in _values(place).items()}
    return values, texts


def _filled(argument: str, place: Path, places: dict[str, Path]) -> str:
    """Put the places of commands into an argument, and the first match for a pattern."""
    told = argument.replace("{D}", str(place))
    for name, other in places.items():
        told = told.replace(f"{{{name}}}", str(other))
    if "*" not in told:
        return told
    start, _, pattern = told.partition("*")
    cut = start.rfind("/")
    return str(sorted(Path(start[:cut]).glob(f"{start[cut + 1 :]}*{pattern}"))[0])


def _masked(text: str, folder: Path, tree: Path) -> str:
    for path in (folder, tree):
        text = text.replace(str(path), "DIR")
    for pattern, word in MASKS:
        text = re.sub(pattern, word, text)
    return _without_times(text)


def _without_times(text: str) -> str:
    """Printed tables without their columns of seconds."""
    lines, column, width = [], None, 0
    for line in text.splitlines():
        words = line.split()
        if fleeting := {"seconds", "train_s"} & set(words):
            column, width = words.index(fleeting.pop()), len(words)
        lines.append(" ".join(words[:column] + words[column + 1 :]) if column and len(words) == width else line)
    return "\n".join(lines)


def _values(place: Path) -> dict[str, str]:
    """Digests of what a command left behind, without what differs from run to run."""
    found: dict[str, list[str]] = {}
    for file in sorted(path for path in place.rglob("*") if path.is_file() and not path.name.startswith(".")):
        name = re.sub(MASKS[0][0], "TIME", file.relative_to(place).as_posix())
        content = _content(file)
        if content is not None:
            found.setdefault(name, []).append(hashlib.sha256(content.encode()).hexdigest()[:16])
    return {name: " ".join(sorted(digests)) for name, digests in found.items()}


def _content(file: Path) -> str | None:
    if file.name == "metrics.jsonl":
        return "\n".join(
            json.dumps(_lasting(json.loads(line)), sort_keys=True) for line in file.read_text().splitlines()
        )
    if file.suffix == ".csv":
        rows = list(csv.DictReader(file.open()))
        return json.dumps([_lasting(row) for row in rows], sort_keys=True)
    if file.suffix == ".json":
        return re.sub(r"[^\"]*/(?=[^/\"]+\")", "", json.dumps(_lasting(json.loads(file.read_text())), sort_keys=True))
    if file.suffix in (".safetensors", ".mp4", ".parquet"):
        return hashlib.sha256(file.read_bytes()).hexdigest()
    return None  # keys, logs, drawings


def _lasting(value: object) -> object:
    """The value without what differs from run to run, under the names that things have now."""
    if isinstance(value, dict):
        renamed = {"arm": "method", "attempts": "rollouts"}
        kept = {key: _lasting(item) for key, item in value.items() if key not in FLEETING}
        return {renamed.get(key, re.sub(*MASKS[0], key)): item for key, item in kept.items()}
    if isinstance(value, list):
        return [_lasting(item) for item in value]
    return re.sub(MASKS[0][0], "TIME", value) if isinstance(value, str) else value


def compare(before: tuple, after: tuple) -> int:
    """Print what is the same and what differs; return how many values differ."""
    (old_values, old_texts), (new_values, new_texts) = before, after
    names = sorted(old_values.keys() | new_values.keys())
    odd = [name for name in names if old_values.get(name) != new_values.get(name)]
    for command in COMMANDS:
        own = [name for name in names if name.startswith(f"{command}/")]
        wrong = [name for name in own if name in odd]
        words = [line for line in unified_diff(old_texts[command], new_texts[command], lineterm="", n=0)][2:]
        said = f"{len(own) - len(wrong)} of {len(own)} values the same" if own else "no values"
        print(f"{command}: {said}; {'the same text' if not words else f'{len(words)} lines of text differ'}")
        for name in wrong:
            print(f"  VALUE {name}: {old_values.get(name)} and {new_values.get(name)}")
        for line in words if not command.endswith("--help") else []:
            print(f"  {line}")
    for engine in ("inline", "simulation", "deployment"):
        weights = [v for name, v in new_values.items() if re.fullmatch(rf"{engine}/.*round_2/model\.safetensors", name)]
        print(f"SHA-256 of the last global model, {engine}: {', '.join(weights)}")
    return len(odd)


def main() -> int:
    """Compare a revision with the working tree."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("revision", help="a commit to compare with")
    revision = parser.parse_args().revision
    with tempfile.TemporaryDirectory(prefix="fedvla-same-") as name:
        old = Path(name) / "before"
        subprocess.run(["git", "worktree", "add", "--detach", "--quiet", str(old), revision], cwd=ROOT, check=True)
        try:
            folders = [Path(name) / part for part in ("old", "new")]
            for folder in folders:
                folder.mkdir()
            found = [behaviour(tree, folder) for tree, folder in zip((old, ROOT), folders, strict=True)]
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(old)], cwd=ROOT, check=True)
    odd = compare(*found)
    print(f"{odd} values differ")
    return 1 if odd else 0


if __name__ == "__main__":
    sys.exit(main())
