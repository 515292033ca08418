"""Check whether this machine can run the book, and say how to fix what is missing.

Each check is one function that returns one `Check` and raises no error for the fault it looks for. Heavy packages are
imported inside the checks (MuJoCo in a separate process, since a wrong driver kills it), so that the doctor still runs
when one of them is broken. It does not know torch, LeRobot or Flower beyond their version numbers.
"""

import importlib.metadata
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement

from fedvla_lib.files import cache_dir

MIN_FREE_GIB = 2.0  # recordings, decoded frames, run folders and pages of all chapters, laptop profile
RENDER_TIMEOUT_S = 120  # the first off-screen context after a boot takes tens of seconds
CODEC = "h264"  # of recorded camera images and of the videos in the pages
MAX_PIXEL_ERROR = 12.0  # mean absolute error of a decoded test frame, out of 255; H.264 stays below 5
APT_RENDERING = "apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri"

# Renders a red box in the middle of the frame; prints the mean colour of the centre and of a corner.
DRAW_A_FRAME = """
import fedvla_lib  # selects the driver as the chapters do, before MuJoCo is imported
import mujoco
model = mujoco.MjModel.from_xml_string('''
<mujoco><worldbody><light pos="0 0 3"/><geom type="box" size=".2 .2 .2" rgba="1 0 0 1"/>
<camera name="top" pos="0 0 1.2"/></worldbody></mujoco>''')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 64, 64) as renderer:
    renderer.update_scene(data, camera="top")
    frame = renderer.render()
print(*frame[28:36, 28:36].mean((0, 1)), *frame[:4, :4].mean((0, 1)))
"""


@dataclass(frozen=True)
class Check:
    """Result of one check; `fix` is the command or action that corrects a failure."""

    name: str
    ok: bool
    found: str
    fix: str = ""
    required: bool = True  # a chapter cannot run without it; otherwise a failure is only a note


def check_packages(requirements: Iterable[str] | None = None) -> Check:
    """Check the installed version of every package in `requirements` (default: the library's dependencies)."""
    declared = (importlib.metadata.requires("fedvla-lib") or []) if requirements is None else requirements
    count, problems = _problems(declared)
    found = "; ".join(problems) or f"{count} packages, all in range"
    return Check("packages", not problems, found, "make env (it installs requirements.lock)")


def check_lock(lock: Path) -> Check:
    """Compare installed with pinned versions; a difference is only a note, since other versions may work."""
    if not lock.is_file():
        return Check("lock", False, f"{lock} does not exist", "run it in the folder of the book", required=False)
    count, problems = _problems(line.rstrip("\\ ") for line in lock.read_text().splitlines() if "==" in line)
    found = f"{count - len(problems)} of {count} packages as pinned"
    return Check("lock", not problems, "; ".join([found, *problems[:3]]), "make env", required=False)


def _problems(lines: Iterable[str]) -> tuple[int, list[str]]:
    """Return how many of the requirements apply to this system, and what is wrong with the installed versions."""
    required = [item for item in map(Requirement, lines) if item.marker is None or item.marker.evaluate({"extra": ""})]
    return len(required), [problem for item in required if (problem := _package_problem(item))]


def _package_problem(requirement: Requirement) -> str:
    """Return what is wrong with the installed version of a package, or an empty string."""
    try:
        version = importlib.metadata.version(requirement.name)
    except importlib.metadata.PackageNotFoundError:
        return f"{requirement.name} is missing"
    if requirement.specifier.contains(version, prereleases=True):
        return ""
    return f"{requirement.name} {version} is not {requirement.specifier}"


def check_rendering(timeout_s: float = RENDER_TIMEOUT_S) -> Check:
    """Render a frame with MuJoCo in a separate process and check its pixels."""
    backend = os.environ.get("MUJOCO_GL", "")
    label, fix = f"MUJOCO_GL={backend or '(not set)'}", _rendering_fix(backend)
    try:
        result = subprocess.run([sys.executable, "-c", DRAW_A_FRAME], capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return Check("rendering", False, f"no frame within {timeout_s:g} s", fix)
    if result.returncode:
        lines = result.stderr.strip().splitlines() or [f"MuJoCo ended with exit status {result.returncode}"]
        reason = next((line for line in reversed(lines) if "Error" in line), lines[-1])
        return Check("rendering", False, f"{label}: {reason.strip()}", fix)
    red, green, blue, *corner = (float(value) for value in result.stdout.split()[-6:])
    ok = red > 100 and red > 1.5 * max(green, blue, *corner)  # bright, red, and only in the middle
    return Check("rendering", ok, f"{label}: a red box was rendered as RGB ({red:.0f}, {green:.0f}, {blue:.0f})", fix)


def _rendering_fix(backend: str) -> str:
    if sys.platform != "linux":
        return "unset MUJOCO_GL: MuJoCo chooses its own driver on this system"
    if backend != "egl":
        return f"export MUJOCO_GL=egl; if it still fails: {APT_RENDERING}"
    return f"{APT_RENDERING}; without a working EGL: apt-get install libosmesa6 && export MUJOCO_GL=osmesa"


def check_video(codec: str = CODEC) -> Check:
    """Encode a moving square, decode it and compare the pixels."""
    fix = "make env (PyAV includes FFmpeg)"
    try:
        error = _round_trip_error(codec)
    except (ImportError, OSError, ValueError) as fault:  # PyAV's errors are subclasses of these
        return Check("video", False, f"{type(fault).__name__}: {fault}", fix)
    return Check("video", error < MAX_PIXEL_ERROR, f"{codec} error {error:.1f} of 255", fix)


def _round_trip_error(codec: str, num_frames: int = 8, size: int = 64) -> float:
    """Return the mean absolute pixel error (out of 255) of a decoded short video; infinity if frames are lost."""
    import numpy as np
    from imageio import v3 as imageio

    frames = np.full((num_frames, size, size, 3), 40, np.uint8)
    for index in range(num_frames):
        frames[index, 16:48, 4 * index : 4 * index + 24] = (200, 60, 60)
    with tempfile.TemporaryDirectory() as folder:
        imageio.imwrite(video := Path(folder) / "square.mp4", frames, plugin="pyav", codec=codec, fps=10)
        decoded = imageio.imread(video, plugin="pyav")
    return float(np.abs(decoded.astype(float) - frames).mean()) if len(decoded) == num_frames else float("inf")


def check_disk(folder: Path, min_free_gib: float = MIN_FREE_GIB) -> Check:
    """Check the free space on the disk that holds `folder`."""
    existing = next(path for path in [folder, *folder.absolute().parents] if path.exists())
    free_gib = shutil.disk_usage(existing).free / 2**30
    fix = f"free {max(min_free_gib - free_gib, 0):.1f} GiB, or export FEDVLA_CACHE=<a folder on a larger disk>"
    found = f"{free_gib:.1f} GiB free, {min_free_gib:g} needed in {existing}"
    return Check("disk", free_gib >= min_free_gib, found, fix)


def check_cache(folder: Path) -> Check:
    """Check that the cache folder exists or can be created, and is writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as scratch:
            scratch.write(b"fedvla")
    except OSError as error:
        return Check("cache", False, f"{folder}: {error.strerror}", "export FEDVLA_CACHE=<a writable folder>")
    return Check("cache", True, f"{folder} is writable")


def examine(folder: Path | None = None) -> list[Check]:
    """Run all checks; `folder` (default: the cache folder) is where recordings are kept."""
    folder = folder or cache_dir()
    lock = Path(__file__).parents[2] / "requirements.lock"
    checks = [check_packages(), check_lock(lock), check_rendering(), check_video()]
    return [*checks, check_cache(folder), check_disk(folder)]


def can_run(checks: Iterable[Check]) -> bool:
    """Return whether every chapter can run, that is, all required checks passed."""
    return all(check.ok for check in checks if check.required)


def table(checks: list[Check]) -> str:
    """Return the checks as text, one line each, with the fix below each failure."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        mark = "ok     " if check.ok else "MISSING" if check.required else "note   "
        lines.append(f"{mark}  {check.name:<{width}}  {check.found}")
        if not check.ok:
            lines.append(f"{'':9}{'':<{width}}  -> {check.fix}")
    lines.append("Every chapter can run here." if can_run(checks) else "Some chapters cannot run: fix what is MISSING.")
    return "\n".join(lines)
