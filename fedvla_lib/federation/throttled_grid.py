"""A Flower grid that sends a few messages at a time and looks for replies often, for Flower's two runtimes."""

import sys
import time
from collections.abc import Iterable
from typing import Any

from flwr.app import Message
from flwr.serverapp import Grid
from flwr.superlink.grid import HttpGrid, InMemoryGrid

# For each client the simulation runtime scans all messages that it holds: n * n for n clients, which with 1,000 clients
# takes longer than their work.
MESSAGES_AT_ONCE = 16  # enough to keep every worker of a machine busy
PULL_INTERVAL_S = 0.1  # as Flower in a simulation; in a deployment it would wait for 3 s


def for_runtime(grid: Grid) -> "Grid | ThrottledGrid":
    """Return `grid`; throttled if it is that of Flower's simulation runtime, unlimited if that of a deployment."""
    limits = {InMemoryGrid: MESSAGES_AT_ONCE, HttpGrid: sys.maxsize}
    limit = next((limit for kind, limit in limits.items() if isinstance(grid, kind)), None)
    return ThrottledGrid(grid, limit) if limit else grid


class ThrottledGrid:
    """Sends a message only when fewer than `limit` are unanswered; delegates everything else to `grid`."""

    def __init__(self, grid: Grid, limit: int) -> None:
        self._grid, self._limit = grid, limit

    def __getattr__(self, name: str) -> Any:
        """Delegate to the grid."""
        return getattr(self._grid, name)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Send all messages and return the replies that arrive within `timeout` seconds, as Flower's grids do."""
        waiting, sent, replies = list(messages)[::-1], set(), []
        deadline = float("inf") if timeout is None else time.monotonic() + timeout
        while (waiting or sent) and time.monotonic() < deadline:
            free = self._limit - len(sent)
            sent |= set(self._grid.push_messages([waiting.pop() for _ in range(min(free, len(waiting)))]))
            back = list(self._grid.pull_messages(sent))
            sent -= {reply.metadata.reply_to_message_id for reply in back}
            replies += back
            if sent and not back:
                time.sleep(PULL_INTERVAL_S)
        return replies
