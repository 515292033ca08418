"""The Flower ClientApp: unpack a message, call `clients`, pack the answer.

Errors are not caught here: Flower turns them into error replies, which the server rejects by client name and reason.
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.clientapp.typing import Mod

from fedvla_lib import clients, wire
from fedvla_lib.config import Config, from_run_config
from fedvla_lib.corrections import ControlVariates, Correction, Parameters, Proximal
from fedvla_lib.model import Bundle
from fedvla_lib.params import Arrays, digest, load_arrays, shapes_of, trainable_arrays
from fedvla_lib.quantise import DOWNWARD, with_feedback

# What a client keeps in its state from round to round, beside SCAFFOLD's control variate.
MOMENTS = "moments"  # its optimiser's
OWN = "own"  # the parts of the model that are personal
LEFT_OVER = "left-over"  # of its changes, what rounding has kept from the server so far


def build(tools: clients.Tools = clients.TOOLS, mods: Sequence[Mod] = ()) -> ClientApp:
    """Return the ClientApp with handlers for query (statistics), train and evaluate.

    Args:
        mods: Flower's functions around a handler, the outermost first.
    """
    app = ClientApp(mods=list(mods))

    @app.query()
    def query(message: Message, context: Context) -> Message:
        client = _client(context, tools)
        answer = wire.note(
            partition_id=client.partition_id,
            num_examples=client.num_examples,
            stats=wire.pack_stats(client.statistics()),
        )
        return Message(RecordDict({wire.NOTE: answer}), reply_to=message)

    @app.train()
    def train(message: Message, context: Context) -> Message:
        client = _client(context, tools)
        bundle = _policy(client, message, tools, context)
        order, exchange = message.content[wire.CONFIG], client.config.exchange
        start = {} if exchange == "float32" else bundle.shared_arrays()  # needed only to send the change
        correction = correction_for(message, context, bundle.shared())
        moments = _recall(context, MOMENTS) if client.config.keep_optimizer else None
        result = client.train(bundle, order[wire.ROUND], correction, moments)
        arrays = _outgoing(bundle.shared_arrays(), start, exchange, context)
        metrics = {
            wire.EXAMPLES: result.num_examples,
            wire.STEPS: result.steps,
            "loss": sum(result.losses) / len(result.losses),
            "seconds": result.seconds,
        }
        records = {
            wire.ARRAYS: wire.pack_arrays(arrays),
            wire.METRICS: MetricRecord(metrics),
            wire.NOTE: wire.note(sha256=digest(arrays)),
        }
        content = RecordDict(records)
        hand_in(content, correction, context)
        if client.config.keep_optimizer:
            context.state[MOMENTS] = wire.pack_arrays(result.moments)
        if bundle.own:
            trained = trainable_arrays(bundle.policy)
            context.state[OWN] = wire.pack_arrays({name: trained[name] for name in bundle.own})
        return Message(content, reply_to=message)

    @app.evaluate()
    def evaluate(message: Message, context: Context) -> Message:
        client = _client(context, tools)
        bundle = _policy(client, message, tools, context)
        examples, metrics = client.validate(bundle)
        content = {
            wire.METRICS: MetricRecord({wire.EXAMPLES: examples, **metrics}),
            wire.NOTE: _rollouts(client, bundle, message.content[wire.CONFIG][wire.ROUND]),
        }
        return Message(RecordDict(content), reply_to=message)

    return app


def reserved_cards() -> list[str]:
    """Return the graphics cards that Flower's simulation runtime has reserved for this client: none elsewhere.

    Its workers are Ray's, where Ray is loaded; nobody else is asked to load it.
    """
    ray = sys.modules.get("ray")
    if ray is None or not ray.is_initialized():
        return []
    return ray.get_runtime_context().get_accelerator_ids().get("GPU", [])


def on_reserved_card(config: Config, cards: Sequence[str]) -> Config:
    """Return settings with which a client computes where the runtime wants it to: on a card that is reserved for it.

    A connection says what its clients get, and the settings of a run do not know it. A device that these name, other
    than the default, stays.
    """
    return replace(config, device="cuda") if cards and config.device == Config.device else config


def _client(context: Context, tools: clients.Tools) -> clients.Client:
    config = on_reserved_card(from_run_config(context.run_config), reserved_cards())
    if wire.PARTITION not in context.node_config:
        raise ValueError(f"this node has no {wire.PARTITION}: start it with --node-config 'partition-id=K'")
    own_data = str(context.node_config.get(wire.DATA, ""))
    return clients.open_client(config, int(context.node_config[wire.PARTITION]), tools, own_data)


def correction_for(message: Message, context: Context, parameters: Parameters) -> Correction | None:
    """Return what the strategy asks to add to gradients: SCAFFOLD sends control variates, FedProx a weight.

    Args:
        parameters: what trains, by name, holding the global arrays of the message.

    Raises:
        ParameterError: the control variates that came are not usable.
    """
    if wire.CONTROL in message.content:
        shapes = shapes_of(parameters)
        server = wire.checked_arrays(message.content, wire.CONFIG, shapes, wire.CONTROL, also=(wire.ARRAYS,))
        return ControlVariates(server, _recall(context, wire.CONTROL))
    mu = message.content[wire.CONFIG].get(wire.PROXIMAL_MU, 0.0)
    return Proximal(parameters, mu) if mu else None


def _outgoing(arrays: Arrays, start: Arrays, exchange: str, context: Context) -> Arrays:
    """What a reply carries: the arrays themselves, or how they changed, in fewer bits."""
    if exchange == "float32":
        return arrays
    change = {name: array - start[name] for name, array in arrays.items()}
    encoded, left_over = with_feedback(change, _recall(context, LEFT_OVER), exchange)
    context.state[LEFT_OVER] = wire.pack_arrays(left_over)
    return encoded


def hand_in(reply: RecordDict, correction: Correction | None, context: Context) -> None:
    """Add to a training reply what the strategy needs beside the arrays, and keep what the client needs next time."""
    if isinstance(correction, ControlVariates):
        change = correction.change()
        reply[wire.CONTROL] = wire.pack_arrays(change)
        reply[wire.NOTE][wire.CONTROL_DIGEST] = digest(change)
        context.state[wire.CONTROL] = wire.pack_arrays(correction.own_after())


def _recall(context: Context, what: str) -> Arrays:
    """What this client kept in an earlier round; Flower stores it with the client on every engine."""
    return wire.unpack_arrays(context.state[what]) if what in context.state else {}


def _policy(client: clients.Client, message: Message, tools: clients.Tools, context: Context) -> Bundle:
    """Return the policy holding the global arrays of the message, once they have passed every check, and its own."""
    own = client.config.normalisation == "own"
    stats = wire.pack_stats(client.statistics()) if own else message.content[wire.CONFIG][wire.STATS]
    bundle = tools.load_policy(client.config, stats)
    exchange = DOWNWARD[client.config.exchange]
    shapes = shapes_of(bundle.shared())
    arrays = wire.checked_arrays(message.content, wire.CONFIG, shapes, also=(wire.CONTROL,), exchange=exchange)
    load_arrays(bundle.policy, arrays | (_recall(context, OWN) or bundle.own))
    return bundle


def _rollouts(client: clients.Client, bundle: Bundle, round_number: int) -> ConfigRecord:
    with tempfile.TemporaryDirectory() as folder:
        due = clients.rolls_out(client.config, round_number)
        return wire.pack_rollouts(client.roll_out(bundle, Path(folder)) if due else [], Path(folder))


app = build()
