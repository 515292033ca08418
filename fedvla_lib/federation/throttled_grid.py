"""A Flower grid that sends a few messages at a time and looks for replies often, for Flower's two runtimes."""

import sys
import time
from collections.abc import Iterable
from typing import Any

from flwr.app import Message
from flwr.serverapp import Grid

# For each client the simulation runtime scans all messages that it holds: n * n for n clients, which with 1,000 clients
# takes longer than their work.
MESSAGES_AT_ONCE = 16  # enough to keep every worker of a machine busy
PULL_INTERVAL_S = 0.1  # Flower's own in a simulation
HTTP_INTERVAL_S = 0.25  # in a deployment, where Flower would wait for 3 s; a request takes the SuperLink 15 ms


def for_runtime(grid: Grid) -> "Grid | ThrottledGrid":
    """Return `grid`; throttled if it is that of Flower's simulation runtime, unlimited if that of a deployment."""
    # Not imported: that loads SQLAlchemy, which takes a second in every process. A grid of its classes has it loaded.
    runtimes = sys.modules.get("flwr.superlink.grid")
    if runtimes is None or not isinstance(grid, (runtimes.HttpGrid, runtimes.InMemoryGrid)):
        return grid
    if isinstance(grid, runtimes.HttpGrid):
        return ThrottledGrid(grid, sys.maxsize, HTTP_INTERVAL_S)
    return ThrottledGrid(grid, MESSAGES_AT_ONCE)


class ThrottledGrid:
    """Sends a message only when fewer than `limit` are unanswered; delegates everything else to `grid`.

    It looks for replies every `interval_s` seconds.
    """

    def __init__(self, grid: Grid, limit: int, interval_s: float = PULL_INTERVAL_S) -> None:
        self._grid, self._limit, self._interval_s = grid, limit, interval_s

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
                time.sleep(self._interval_s)
        return replies
