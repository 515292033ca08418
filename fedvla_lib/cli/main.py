"""The entry point of `fedvla`.

Bad input ends with one line on stderr and exit status 2, Ctrl-C with a line that says what is kept and status 130.
`kill` and closing the terminal are handled like Ctrl-C.
"""

import argparse
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from fedvla_lib.cli.commands import FAILED
from fedvla_lib.cli.parser import build_parser

EXPECTED = (ValueError, OSError, RuntimeError, FloatingPointError)  # the library raises these with a message for users
COUNTS = ("episodes", "jobs", "nodes", "rollouts", "steps", "trials")  # flags with a number above zero
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
# From kill, and from a closing terminal.
SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    options = build_parser().parse_args(argv)
    try:
        _check_counts(options)
        with _signals_as_ctrl_c():
            return options.handler(options) or 0
    except KeyboardInterrupt:
        print(f"\ninterrupted: {options.kept}", file=sys.stderr)
        return INTERRUPTED
    except EXPECTED as error:
        if options.traceback:
            traceback.print_exc()
        message = " ".join(str(error).split()) or type(error).__name__
        print(f"fedvla {options.command}: {message}", file=sys.stderr)
        return FAILED


def _check_counts(options: argparse.Namespace) -> None:
    for name in COUNTS:
        if (value := getattr(options, name, None)) is not None and value < 1:
            raise ValueError(f"--{name} {value} is not usable: give 1 or more")


@contextmanager
def _signals_as_ctrl_c() -> Iterator[None]:
    """Let `SIGNALS` raise KeyboardInterrupt, so that commands stop what they started. Ignored ones (nohup) stay so."""
    on_main_thread = threading.current_thread() is threading.main_thread()  # only there may signals be handled
    handled = [sign for sign in SIGNALS if on_main_thread and signal.getsignal(sign) is signal.SIG_DFL]
    for sign in handled:
        signal.signal(sign, signal.default_int_handler)
    try:
        yield
    finally:
        for sign in handled:
            signal.signal(sign, signal.SIG_DFL)
