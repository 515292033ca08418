"""Rendered control steps per second: this arm against two published simulators of its sister, the SO-101.

Each peer runs in its own Python environment, installed by uv from the package registry and kept in uv's cache, on its
own pick scene, with images as small as ours where their size can be set. A peer that cannot be installed is left out.

    python benchmarks/peers.py
"""

import json
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

from control_steps import seconds_per_step
from fedvla_lib.robot.sim import So100Env
from report import laptop, options, report, start

# Runs in a peer's process after the code that makes `env`: prints the seconds per control step.
TIMING = """
import json, time
env.reset(seed=0)
rest = env.action_space.sample() * 0
env.step(rest)
began = time.perf_counter()
for _ in range(STEPS):
    env.step(rest)
print(json.dumps((time.perf_counter() - began) / STEPS))
"""
NEXUS = """
import gymnasium, so101_nexus.mujoco
from so101_nexus.config import PickAndPlaceConfig
from so101_nexus.observations import JointPositions, OverheadCamera, WristCamera
cameras = [camera(width=PIXELS, height=PIXELS) for camera in (WristCamera, OverheadCamera)]
config = PickAndPlaceConfig(obs_mode="visual", observations=[JointPositions(), *cameras])
env = gymnasium.make("MuJoCoPickAndPlace-v1", config=config)
"""
PLUGIN = """
import gymnasium, lerobot_env_so101
env = gymnasium.make("lerobot_env_so101/SO101PickCube-v0", image_obs=True, render_mode="rgb_array")
"""
PEERS = {  # requirement -> (code that makes `env`, cameras, pixels or None if adjustable, control steps per second)
    "so101-nexus==0.10.0": (NEXUS, 2, None, 50),
    "lerobot-env-so101==0.4.0": (PLUGIN, 1, 128, 10),
}


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40, help="control steps per measurement of this library")
    parser.add_argument("--peer-steps", type=int, default=10, help="control steps per measurement of a peer")
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=list(PEERS), help="packages to measure")
    chosen = parser.parse_args()
    config = laptop(chosen.profile)
    env = So100Env("lift", config.image_size)
    ours_s = seconds_per_step(env, chosen)
    rows = [_row("this library", len(env.cameras), config.image_size, env.metadata["render_fps"], ours_s, ours_s)]
    for peer in chosen.peers:
        make, cameras, pixels, rate_hz = PEERS[peer]
        theirs_s = peer_seconds_per_step(peer, make, config.image_size, chosen)
        if theirs_s is not None:
            rows.append(_row(peer, cameras, pixels or config.image_size, rate_hz, theirs_s, ours_s))
    report("peers", rows, chosen.out)


def _row(name: str, cameras: int, pixels: int, rate_hz: int, seconds: float, ours_s: float) -> dict[str, object]:
    return {
        "simulator": name,
        "cameras": cameras,
        "pixels": pixels,
        "control [Hz]": rate_hz,
        "steps/s": 1 / seconds,
        "ours is faster by": seconds / ours_s,
    }


def peer_seconds_per_step(peer: str, make: str, pixels: int, chosen: Namespace) -> float | None:
    """Return the seconds of one control step of a peer, None if it cannot be installed or run."""
    local = Path(__file__).parents[1] / ".uv/bin/uv"
    uv = str(local) if local.is_file() else shutil.which("uv")
    if uv is None:
        print(f"{peer}: left out, uv is not installed", file=sys.stderr)
        return None
    code = f"PIXELS, STEPS = {pixels}, {chosen.peer_steps}\n{make}{TIMING}"
    isolated = [uv, "run", "--quiet", "--no-project", "--isolated", "--python", sys.executable, "--with", peer]
    done = subprocess.run([*isolated, "python", "-c", code], capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        print(f"{peer}: left out, {reason}", file=sys.stderr)
        return None
    return float(json.loads(done.stdout.strip().splitlines()[-1]))


if __name__ == "__main__":
    start(main)
