"""The throttled grid: few messages in flight in Flower's simulation runtime."""

import time

import pytest
from flwr.app import Context, Message, MessageType, RecordDict
from flwr.clientapp import ClientApp
from flwr.server.superlink.linkstate import LinkStateFactory
from flwr.supercore.object_store import ObjectStoreFactory
from flwr.superlink.federation import NoOpFederationManager
from flwr.superlink.grid import HttpGrid, InMemoryGrid

from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.engines.inline import RUN_ID, InlineGrid, claim_identity
from fedvla_lib.federation import server_app
from fedvla_lib.federation.throttled_grid import MESSAGES_AT_ONCE, ThrottledGrid, for_runtime

pytestmark = pytest.mark.unit
CLIENTS = 10


class Counting(InlineGrid):
    """Records how many messages it was given at a time."""

    def push_messages(self, messages):
        given = list(messages)
        self.given = [*getattr(self, "given", []), len(given)]
        return super().push_messages(given)


def grid_of(answer_s: float = 0.0) -> Counting:
    claim_identity()
    app = ClientApp()

    @app.query()
    def answer(message, _):
        time.sleep(answer_s)
        return Message(RecordDict(), reply_to=message)

    return Counting(app, CLIENTS, {})


def questions(grid) -> list[Message]:
    return [Message(RecordDict(), dst_node_id=node, message_type=MessageType.QUERY) for node in grid.get_node_ids()]


@pytest.mark.parametrize("limit", [1, 3, CLIENTS, 100])
def test_everyone_is_asked_once_and_never_more_than_the_limit_at_a_time(limit):
    grid = grid_of()
    replies = ThrottledGrid(grid, limit).send_and_receive(questions(grid))
    assert sorted(reply.metadata.src_node_id for reply in replies) == sorted(grid.get_node_ids())
    assert max(grid.given) <= limit
    assert sum(grid.given) == CLIENTS


def test_who_was_not_asked_in_time_has_not_replied():
    grid = grid_of(answer_s=0.1)
    replies = ThrottledGrid(grid, 1).send_and_receive(questions(grid), timeout=0.25)
    assert 1 <= len(replies) < CLIENTS


def in_memory(kind=InMemoryGrid) -> InMemoryGrid:
    return kind(LinkStateFactory(":flwr-in-memory:", NoOpFederationManager(), ObjectStoreFactory()))


def test_only_the_grid_of_the_simulation_is_limited():
    assert isinstance(for_runtime(in_memory()), ThrottledGrid)
    assert for_runtime(inline := grid_of()) is inline
    deployed = for_runtime(HttpGrid("127.0.0.1:1", insecure=True, token="none"))
    assert deployed._limit > 1e6 and deployed._interval_s < 1  # Flower's own grid would look every three seconds


class Asked(InMemoryGrid):
    """The simulation's grid with many clients; at the first messages it stops the run with their number."""

    def get_node_ids(self):
        return range(1, 1 + 2 * MESSAGES_AT_ONCE)

    def push_messages(self, messages):
        raise InterruptedError(len(list(messages)))


def test_the_server_of_a_simulation_asks_few_clients_at_a_time(recording, tmp_path):
    claim_identity()
    config = from_profile("tiny", data=str(recording), num_clients=2 * MESSAGES_AT_ONCE, out=str(tmp_path))
    context = Context(RUN_ID, 0, {}, RecordDict(), to_run_config(config))
    with pytest.raises(InterruptedError) as asked:
        server_app.build()(in_memory(Asked), context)
    assert asked.value.args == (MESSAGES_AT_ONCE,)
