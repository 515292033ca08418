"""Flower's grid, made to hold few messages at a time where it keeps them in this process's memory."""

import time
from collections.abc import Iterable
from typing import Any

from flwr.app import Message
from flwr.serverapp import Grid
from flwr.superlink.grid import InMemoryGrid

# The simulation runtime looks through every message it holds once for each client, over and over: with a message for
# each of n clients that is n * n looks, which at 1,000 clients takes more time than the clients' own work.
MESSAGES_AT_ONCE = 16  # enough for every worker of a machine to have its next one waiting
PULL_INTERVAL_S = 0.1  # Flower's own


def for_simulation(grid: Grid) -> "Grid | ThrottledGrid":
    """Return `grid`, or what limits it if it is that of Flower's simulation; others do not look through messages."""
    return ThrottledGrid(grid, MESSAGES_AT_ONCE) if isinstance(grid, InMemoryGrid) else grid


class ThrottledGrid:
    """A grid of Flower's that sends a message when the reply to an earlier one is back; all else is the grid's own.

    Args:
        grid: does the work.
        limit: how many messages may be without a reply.
    """

    def __init__(self, grid: Grid, limit: int) -> None:
        self._grid, self._limit = grid, limit

    def __getattr__(self, name: str) -> Any:
        """Return what the grid has under that name."""
        return getattr(self._grid, name)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Send all and return the replies that are back before `timeout` seconds are over, as Flower's grids do."""
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
