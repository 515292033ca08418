"""The Flower ClientApp: unpack a message, call `clients`, pack the answer.

Errors are not caught here: Flower turns them into error replies, which the server rejects by client name and reason.
"""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flwr.app import Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.clientapp.typing import Mod

from fedvla_lib.config import Config, from_run_config
from fedvla_lib.data import normalisation
from fedvla_lib.evaluation import measure
from fedvla_lib.federation import messages
from fedvla_lib.federation.client import LOADERS, Client, Loaders, open_client
from fedvla_lib.federation.quantisation import DOWNWARD, with_feedback
from fedvla_lib.federation.strategies.fedprox import Proximal
from fedvla_lib.federation.strategies.scaffold import ControlVariates
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.parameters import Arrays, digest, load_arrays, shapes_of, trainable_arrays
from fedvla_lib.policy.training import Correction, Parameters

# What a client keeps in its state from round to round, beside SCAFFOLD's control variate.
MOMENTS = "moments"  # its optimiser's
OWN = "own"  # the parts of the model that are personal
LEFT_OVER = "left-over"  # of its changes, what rounding has kept from the server so far


def build(loaders: Loaders = LOADERS, mods: Sequence[Mod] = ()) -> ClientApp:
    """Return the ClientApp with handlers for query (statistics), train and evaluate.

    Args:
        mods: Flower's functions around a handler, the outermost first.
    """
    app = ClientApp(mods=list(mods))

    @app.query()
    def query(message: Message, context: Context) -> Message:
        return Message(_introduction(_client(context, loaders)), reply_to=message)

    @app.train()
    def train(message: Message, context: Context) -> Message:
        client = _client(context, loaders)
        bundle = _policy(client, message, loaders, context)
        return Message(_trained(client, bundle, message, context), reply_to=message)

    @app.evaluate()
    def evaluate(message: Message, context: Context) -> Message:
        client = _client(context, loaders)
        bundle = _policy(client, message, loaders, context)
        return Message(_evaluated(client, bundle, message.content[messages.CONFIG][messages.ROUND]), reply_to=message)

    return app


def _introduction(client: Client) -> RecordDict:
    stats = normalisation.pack_stats(client.statistics())
    note = messages.make_note(partition_id=client.partition_id, num_examples=client.num_examples, stats=stats)
    return RecordDict({messages.NOTE: note})


def _trained(client: Client, bundle: Bundle, message: Message, context: Context) -> RecordDict:
    """Train for one round, keep what the client keeps between rounds, and return the reply's content."""
    exchange, keeps_moments = client.config.exchange, client.config.keep_optimizer
    start = {} if exchange == "float32" else bundle.shared_arrays()  # needed only to send the change
    correction = correction_for(message, context, bundle.shared())
    moments = _load_state(context, MOMENTS) if keeps_moments else None
    result = client.train(bundle, message.content[messages.CONFIG][messages.ROUND], correction, moments)
    arrays = _outgoing(bundle.shared_arrays(), start, exchange, context)
    metrics = {
        messages.EXAMPLES: result.num_examples,
        messages.STEPS: result.steps,
        "loss": sum(result.losses) / len(result.losses),
        "seconds": result.seconds,
    }
    content = RecordDict({
        messages.ARRAYS: messages.pack_arrays(arrays), messages.METRICS: MetricRecord(metrics),
        messages.NOTE: messages.make_note(sha256=digest(arrays)),
    })  # fmt: skip
    attach_control_variates(content, correction, context)
    if keeps_moments:
        context.state[MOMENTS] = messages.pack_arrays(result.moments)
    if bundle.own:
        trained = trainable_arrays(bundle.policy)
        context.state[OWN] = messages.pack_arrays({name: trained[name] for name in bundle.own})
    return content


def _evaluated(client: Client, bundle: Bundle, round_number: int) -> RecordDict:
    examples, metrics = client.validate(bundle)
    with tempfile.TemporaryDirectory() as folder:
        due = measure.rolls_out(client.config, round_number)
        rollouts = messages.pack_rollouts(client.roll_out(bundle, Path(folder)) if due else [], Path(folder))
    return RecordDict({
        messages.METRICS: MetricRecord({messages.EXAMPLES: examples, **metrics}), messages.NOTE: rollouts,
    })  # fmt: skip


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


def _client(context: Context, loaders: Loaders) -> Client:
    config = on_reserved_card(from_run_config(context.run_config), reserved_cards())
    if messages.PARTITION not in context.node_config:
        raise ValueError(f"this node has no {messages.PARTITION}: start it with --node-config 'partition-id=K'")
    own_data = str(context.node_config.get(messages.DATA, ""))
    return open_client(config, int(context.node_config[messages.PARTITION]), loaders, own_data)


def correction_for(message: Message, context: Context, parameters: Parameters) -> Correction | None:
    """Return what the strategy asks to add to gradients: SCAFFOLD sends control variates, FedProx a weight.

    Args:
        parameters: what trains, by name, holding the global arrays of the message.

    Raises:
        ParameterError: the control variates that came are not usable.
    """
    if messages.CONTROL in message.content:
        shapes = shapes_of(parameters)
        server = messages.checked_arrays(
            message.content, messages.CONFIG, shapes, messages.CONTROL, also=(messages.ARRAYS,)
        )
        return ControlVariates(server, _load_state(context, messages.CONTROL))
    mu = message.content[messages.CONFIG].get(messages.PROXIMAL_MU, 0.0)
    return Proximal(parameters, mu) if mu else None


def _outgoing(arrays: Arrays, start: Arrays, exchange: str, context: Context) -> Arrays:
    """What a reply carries: the arrays themselves, or how they changed, in fewer bits."""
    if exchange == "float32":
        return arrays
    change = {name: array - start[name] for name, array in arrays.items()}
    encoded, left_over = with_feedback(change, _load_state(context, LEFT_OVER), exchange)
    context.state[LEFT_OVER] = messages.pack_arrays(left_over)
    return encoded


def attach_control_variates(reply: RecordDict, correction: Correction | None, context: Context) -> None:
    """Add to a training reply what the strategy needs beside the arrays, and keep what the client needs next time."""
    if isinstance(correction, ControlVariates):
        change = correction.change()
        reply[messages.CONTROL] = messages.pack_arrays(change)
        reply[messages.NOTE][messages.CONTROL_DIGEST] = digest(change)
        context.state[messages.CONTROL] = messages.pack_arrays(correction.own_after())


def _load_state(context: Context, what: str) -> Arrays:
    """What this client kept in an earlier round; Flower stores it with the client on every engine."""
    return messages.unpack_arrays(context.state[what]) if what in context.state else {}


def _policy(client: Client, message: Message, loaders: Loaders, context: Context) -> Bundle:
    """Return the policy holding the global arrays of the message, once they have passed every check, and its own."""
    own = client.config.normalisation == "own"
    sent = message.content[messages.CONFIG][messages.STATS]
    stats = client.statistics() if own else normalisation.unpack_stats(sent)
    bundle = loaders.load_policy(client.config, stats)
    exchange = DOWNWARD[client.config.exchange]
    shapes = shapes_of(bundle.shared())
    arrays = messages.checked_arrays(
        message.content, messages.CONFIG, shapes, also=(messages.CONTROL,), exchange=exchange
    )
    load_arrays(bundle.policy, arrays | (_load_state(context, OWN) or bundle.own))
    return bundle


app = build()
