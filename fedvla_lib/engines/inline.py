"""Run the Flower app in this process, for notebooks, tests and debugging.

A Flower `Grid` calls the ClientApp directly, one client after the other in the order of their partitions, or several at
a time in worker processes, with the same result. To scale up, run the same app with `simulation` or `deployment`.
"""

import copy
import itertools
import logging
import time
import traceback
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from flwr.app import Context, Error, Message, RecordDict, UserConfig
from flwr.clientapp import ClientApp
from flwr.common.constant import SUPERLINK_NODE_ID, ErrorCode
from flwr.serverapp import Grid
from flwr.supercore.run import Run
from flwr.supercore.task_identity import TaskIdentity
from tqdm.auto import tqdm

from fedvla_lib.config import Config, check, to_run_config
from fedvla_lib.federation import client, client_app, server_app
from fedvla_lib.federation.client import cached
from fedvla_lib.federation.messages import DATA, PARTITION, pack_arrays, unpack_arrays
from fedvla_lib.federation.strategies.build import brought
from fedvla_lib.policy.parameters import Arrays
from fedvla_lib.workers import processes

logger = logging.getLogger(__name__)
RUN_ID = 1
FIRST_NODE_ID = SUPERLINK_NODE_ID + 1


def run_inline(
    config: Config, *, clients_app: ClientApp | None = None, data: Sequence[Path] = (), progress: bool = True,
    raise_errors: bool = False, jobs: int = 1,
) -> Path:  # fmt: skip
    """Run a federation in this process and return its run folder; results are bitwise reproducible.

    Args:
        clients_app: the ClientApp to call; default this library's, with frames and policy loaded once for all clients.
        data: a data set for each client; empty: each client uses its partition of ``config.data``.
        progress: show a progress bar over the clients of each round.
        raise_errors: re-raise a client's exception (for debugging) instead of rejecting its reply.
        jobs: clients of a round, and groups of rollouts of the global model, that are run at a time, each in its own
            process with this library's ClientApp.

    Raises:
        TooFewReplies: a round had fewer valid replies than `config.min_replies`; the run folder is kept.
        ValueError: unusable settings, data or output folder.
    """
    if jobs > 1 and (clients_app or raise_errors):
        raise ValueError(f"jobs={jobs}: clients_app and raise_errors need jobs=1, which runs clients in this process")
    if ":" in config.strategy:
        brought(config.strategy)  # or end before there is a run folder
    loaders = cached(client.LOADERS)
    app = clients_app or client_app.build(loaders)
    run_config = to_run_config(check(config))
    context = Context(RUN_ID, SUPERLINK_NODE_ID, {}, RecordDict(), run_config)
    claim_identity()
    flower = logging.getLogger("flwr")
    with ExitStack() as stack:
        stack.callback(flower.setLevel, flower.level)
        flower.setLevel(logging.WARNING)  # without its info log; the run folder has the same events
        grid = InlineGrid(app, config.num_clients, run_config, data, progress=progress, raise_errors=raise_errors)
        grid.pool = stack.enter_context(processes(jobs)) if jobs > 1 else None
        server_app.build(loaders, engine="inline", progress=progress, jobs=jobs)(grid, context)
    return Path(context.state["run"]["folder"])


class InlineGrid(Grid):
    """A Flower grid without a network: messages are handled as they are sent, exceptions become error replies.

    Args:
        app: handles the messages of all clients.
        num_clients: number of clients; client k is node ``FIRST_NODE_ID + k`` with partition-id k and its own context.
        run_config: settings of the run in Flower's format.
        data: a data set for each client; empty: all use `config.data`.
    """

    pool: Executor | None = None  # worker processes that handle messages in place of `app`

    def __init__(
        self, app: ClientApp, num_clients: int, run_config: UserConfig, data: Sequence[Path] = (), *,
        progress: bool = False, raise_errors: bool = False,
    ) -> None:  # fmt: skip
        self._app, self._progress, self._raise_errors = app, progress, raise_errors
        self._run = Run.create_empty(RUN_ID)
        self._replies: dict[str, Message] = {}
        self._took_s: dict[str, float] = {}
        self._ids = itertools.count()
        self._contexts = {}
        for k in range(num_clients):
            node, node_config = FIRST_NODE_ID + k, {PARTITION: k, "num-partitions": num_clients}
            if data:
                node_config[DATA] = str(Path(data[k]).resolve())
            self._contexts[node] = Context(RUN_ID, node, node_config, RecordDict(), dict(run_config))

    def set_run(self, run: Run) -> None:
        """Set the description of the run."""
        self._run = run

    @property
    def run(self) -> Run:
        """Description of the run."""
        return self._run

    def create_message(
        self, content: RecordDict, message_type: str, dst_node_id: int, group_id: str, ttl: float | None = None
    ) -> Message:
        """Return a message to a node, as Flower's constructor does."""
        return Message(content, dst_node_id, message_type, ttl=ttl, group_id=group_id)

    def get_node_ids(self) -> list[int]:
        """Return the node ids in the order of partitions."""
        return list(self._contexts)

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Handle the messages in the order of nodes and return their ids."""
        ordered = sorted(messages, key=lambda message: message.metadata.dst_node_id)
        kind = ordered[0].metadata.message_type if ordered else ""
        contexts = [self._contexts[message.metadata.dst_node_id] for message in ordered]
        for message in ordered:
            message.metadata.__dict__["_message_id"] = str(next(self._ids))  # replies refer to it, as on Flower's grids
        here = partial(_handle, self._app, raise_errors=self._raise_errors)
        handled = self.pool.map(_in_worker, ordered, contexts) if self.pool else map(here, ordered, contexts)
        bar = tqdm(handled, total=len(ordered), desc=f"clients: {kind}", disable=not (self._progress and ordered),
                   leave=False)  # fmt: skip
        for message, (reply, context, seconds) in zip(ordered, bar, strict=True):
            key = message.metadata.message_id
            self._replies[key], self._took_s[key] = reply, seconds
            self._contexts[message.metadata.dst_node_id] = context
        return [message.metadata.message_id for message in ordered]

    def pull_messages(self, message_ids: Iterable[str]) -> list[Message]:
        """Return the replies to the given messages, each only once."""
        return [self._replies.pop(key) for key in message_ids if key in self._replies]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Push and pull, dropping the replies of clients that took longer than `timeout` seconds.

        Each client is timed separately, as if all ran in parallel on their own machines.
        """
        sent = self.push_messages(messages)
        replies = zip(sent, self.pull_messages(sent), strict=True)
        return [reply for key, reply in replies if timeout is None or self._took_s[key] <= timeout]

    def client_states(self) -> dict[str, Arrays]:
        """Return the arrays in the clients' contexts by ``node:record``."""
        return {
            f"{node}:{name}": unpack_arrays(record)
            for node, context in self._contexts.items()
            for name, record in context.state.array_records.items()
        }

    def restore_clients(self, states: dict[str, Arrays]) -> None:
        """Restore the arrays of `client_states` in the clients' contexts."""
        for key, arrays in states.items():
            node, name = key.split(":", 1)
            self._contexts[int(node)].state[name] = pack_arrays(arrays)


def _handle(app: ClientApp, message: Message, context: Context, raise_errors: bool) -> tuple[Message, Context, float]:
    """Return a client's reply, or the error reply for its exception, its context, and the seconds that it took.

    The client gets a copy, as over a network, so that its changes do not reach the server's records.
    """
    began = time.perf_counter()
    kept = {id(array): copy.copy(array) for of in message.content.array_records.values() for array in of.values()}
    try:
        reply = app(copy.deepcopy(message, kept), context)  # the bytes of arrays cannot be changed
    except Exception as error:
        if raise_errors:
            raise
        logger.debug("client on node %d raised\n%s", context.node_id, traceback.format_exc())
        failure = Error(code=ErrorCode.CLIENT_APP_RAISED_EXCEPTION, reason=f"{type(error).__name__}: {error}")
        reply = Message(failure, reply_to=message)
    return reply, context, time.perf_counter() - began


def _in_worker(message: Message, context: Context) -> tuple[Message, Context, float]:
    """Handle a message in a worker process, whose app keeps frames and policy between messages."""
    claim_identity()
    return _handle(client_app.app, message, context, raise_errors=False)


def claim_identity() -> None:
    """Set the identity of this process for Flower's message class, as Flower's runtimes do before they start an app."""
    TaskIdentity.run_id, TaskIdentity.node_id, TaskIdentity.task_id = RUN_ID, SUPERLINK_NODE_ID, 0
