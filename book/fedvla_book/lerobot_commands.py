"""LeRobot's own commands in this process, on a simulated clock: imports are paid once, and nothing waits.

The commands are LeRobot's `main` with a command line. Only what tells and spends time is replaced, so that a second of
an episode has as many frames on a busy machine as on an idle one.
"""

import contextlib
import importlib
import io
import logging
import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from unittest.mock import patch

import av
import pandas as pd

# Importing them is what makes LeRobot know the simulated arm and the script, as its plugins do.
from fedvla_lib.robot import config_lerobot_robot as config_lerobot_robot
from fedvla_lib.robot import config_lerobot_teleoperator as config_lerobot_teleoperator

LOOPS = ("rollout.strategies.base", "rollout.strategies.core")  # where lerobot-rollout waits
TIMED = ("fedvla_lib.robot.lerobot_teleoperator",)
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)  # lerobot-rollout keeps them for itself
ARM = "fedvla_lib.robot"  # whose log lines are returned


class Clock:
    """Counts seconds; only waiting takes time."""

    now_s = 0.0

    def perf_counter(self) -> float:
        """Return the time, in seconds."""
        return self.now_s

    def precise_sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now_s += seconds


def run(command: str, flags: Mapping[str, object] | Sequence[str]) -> list[str]:
    """Run a command such as ``lerobot-record``, and return what the simulated arm logged, and the warnings of all.

    Args:
        flags: as `arguments` takes them, or as a command line has them.
    """
    line = arguments(flags) if isinstance(flags, Mapping) else flags
    module = importlib.import_module(f"lerobot.scripts.{command.replace('-', '_')}")
    with contextlib.ExitStack() as changed, _listening() as lines:
        clock = Clock()
        for loop in (module, *(importlib.import_module(f"lerobot.{name}") for name in LOOPS)):
            if hasattr(loop, "precise_sleep"):
                changed.enter_context(patch.object(loop, "time", clock))
                changed.enter_context(patch.object(loop, "precise_sleep", clock.precise_sleep))
        for name in TIMED:
            changed.enter_context(patch.object(importlib.import_module(name), "time", clock))
        if hasattr(module, "init_logging"):  # it would write to the page
            changed.enter_context(patch.object(module, "init_logging"))
        changed.enter_context(patch.object(sys, "argv", [command, *line]))
        changed.enter_context(contextlib.redirect_stdout(io.StringIO()))
        changed.enter_context(contextlib.redirect_stderr(io.StringIO()))
        for sign in SIGNALS:
            changed.callback(signal.signal, sign, signal.getsignal(sign))
        module.main()
    return lines


@contextlib.contextmanager
def _listening() -> Iterator[list[str]]:
    """Collect log lines in place of the handlers that would write them to the page."""
    lines: list[str] = []
    handler, root, arm = logging.Handler(), logging.getLogger(), logging.getLogger(ARM)
    handler.emit = lambda record: lines.append(record.getMessage())
    before = root.handlers, root.level, arm.level
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    arm.setLevel(logging.INFO)
    av.logging.set_libav_level(av.logging.ERROR)  # its encoders write to the terminal without Python
    try:
        yield lines
    finally:
        root.handlers, root.level, arm.level = before


def arguments(flags: Mapping[str, object]) -> list[str]:
    """Return flags, given without dashes such as ``{"robot.type": "so100_sim"}``, as a command line has them."""
    return [f"--{name}={str(value).lower() if isinstance(value, bool) else value}" for name, value in flags.items()]


def cameras(names: Sequence[str], fps: int, width: int = 640, height: int = 480) -> str:
    """Return the value of ``--robot.cameras`` for cameras in the order of their numbers."""
    form = "{name}: {{type: opencv, index_or_path: {index}, width: {width}, height: {height}, fps: {fps}}}"
    size = {"width": width, "height": height, "fps": fps}
    return "{" + ", ".join(form.format(name=name, index=index, **size) for index, name in enumerate(names)) + "}"


def side_by_side(**commands: Mapping[str, object]) -> pd.DataFrame:
    """Return two command lines as a table, a row for each flag, with those marked that differ."""
    names = sorted({name for flags in commands.values() for name in flags})
    table = pd.DataFrame(
        {who: [shlex.quote(arguments({"": flags[name]})[0][3:]) if name in flags else "" for name in names]
         for who, flags in commands.items()},
        index=[f"--{name}" for name in names],
    )  # fmt: skip
    one, other = (table[who] for who in commands)
    return table.assign(differs=["" if same else "◀" for same in one == other]).rename_axis(index="flag")
