"""Few messages at a time, where Flower's simulation would look through all of them for every client."""

import time

import pytest
from flwr.app import Message, MessageType, RecordDict
from flwr.clientapp import ClientApp
from flwr.server.superlink.linkstate import LinkStateFactory
from flwr.supercore.object_store import ObjectStoreFactory
from flwr.superlink.federation import NoOpFederationManager
from flwr.superlink.grid import InMemoryGrid

from fedvla_lib.engine import InlineGrid, claim_identity
from fedvla_lib.grid import FewAtOnce, for_simulation

pytestmark = pytest.mark.unit
CLIENTS = 10


class Counting(InlineGrid):
    """Notes how many messages it was given at a time."""

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
    replies = FewAtOnce(grid, limit).send_and_receive(questions(grid))
    assert sorted(reply.metadata.src_node_id for reply in replies) == sorted(grid.get_node_ids())
    assert max(grid.given) <= limit
    assert sum(grid.given) == CLIENTS


def test_who_was_not_asked_in_time_has_not_replied():
    grid = grid_of(answer_s=0.1)
    replies = FewAtOnce(grid, 1).send_and_receive(questions(grid), timeout=0.25)
    assert 1 <= len(replies) < CLIENTS


def test_only_the_grid_of_the_simulation_is_limited():
    memory = InMemoryGrid(LinkStateFactory(":flwr-in-memory:", NoOpFederationManager(), ObjectStoreFactory()))
    assert isinstance(for_simulation(memory), FewAtOnce)
    assert for_simulation(inline := grid_of()) is inline
