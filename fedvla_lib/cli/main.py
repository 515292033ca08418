"""The entry point of `fedvla`.

Bad input ends with one line on stderr and exit status 2, Ctrl-C with a line that says what is kept and status 130.
`kill` and closing the terminal are handled like Ctrl-C.
"""

import argparse
import signal
import sys
import tempfile
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
    options, received = build_parser().parse_args(argv), []
    try:
        _check_counts(options)
        with _signals_as_ctrl_c(received):
            return options.handler(options) or 0
    except KeyboardInterrupt:
        return _interrupted(options.kept)
    except EXPECTED as error:
        if options.traceback:
            traceback.print_exc()
        if received:  # code that was interrupted may raise an error of its own
            return _interrupted(options.kept, error)
        return _failed(options.command, error)
    except Exception as error:  # a mistake of ours: the user gets one line all the same, and we get the traceback
        if received:  # ctypes makes an ArgumentError of it
            return _interrupted(options.kept, error)
        with tempfile.NamedTemporaryFile("w", prefix="fedvla-", suffix=".log", delete=False) as log:
            traceback.print_exc(file=log)
        return _failed(options.command, error, f" (this should not happen: the traceback is in {log.name})")


def _interrupted(kept: str, error: Exception | None = None) -> int:
    beside = f" (then {type(error).__name__}: {' '.join(str(error).split())})" if error else ""
    print(f"\ninterrupted: {kept}{beside}", file=sys.stderr)
    return INTERRUPTED


def _failed(command: str, error: Exception, beside: str = "") -> int:
    message = " ".join(str(error).split())
    message = message if isinstance(error, EXPECTED) and message else f"{type(error).__name__} {message}".strip()
    print(f"fedvla {command}: {message}{beside}", file=sys.stderr)
    return FAILED


def _check_counts(options: argparse.Namespace) -> None:
    for name in COUNTS:
        if (value := getattr(options, name, None)) is not None and value < 1:
            raise ValueError(f"--{name} {value} is not usable: give 1 or more")


@contextmanager
def _signals_as_ctrl_c(received: list[int]) -> Iterator[None]:
    """Let `SIGNALS` raise KeyboardInterrupt, so that commands stop what they started. Ignored ones (nohup) stay so.

    Args:
        received: gets the number of each signal.
    """

    def interrupt(number: int, _: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    on_main_thread = threading.current_thread() is threading.main_thread()  # only there may signals be handled
    before = {sign: signal.getsignal(sign) for sign in (*SIGNALS, signal.SIGINT) if on_main_thread}
    usual = {sign: how for sign, how in before.items() if how in (signal.SIG_DFL, signal.default_int_handler)}
    for sign in usual:
        signal.signal(sign, interrupt)
    try:
        yield
    finally:
        for sign, how in usual.items():
            signal.signal(sign, how)
