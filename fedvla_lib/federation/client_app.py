"""The Flower ClientApp: unpack a message, call `federation.client`, pack the reply.

Exceptions are not caught here: Flower turns them into error replies, which the server rejects with client and reason.
"""

import logging
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.clientapp.typing import ClientAppCallable, Mod

from fedvla_lib.config import Config, from_run_config
from fedvla_lib.data import normalisation
from fedvla_lib.evaluation import measure
from fedvla_lib.federation import accountant, messages, node_keys, privacy, rollout_replies, secure_round
from fedvla_lib.federation.client import LOADERS, WORKER_LOADERS, Client, Loaders, open_client
from fedvla_lib.federation.quantisation import DOWNWARD, decode, with_feedback
from fedvla_lib.federation.strategies.fedprox import Proximal
from fedvla_lib.federation.strategies.scaffold import ControlVariates
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.parameters import Arrays, digest, load_arrays, shapes_of, trainable_arrays
from fedvla_lib.policy.training import Correction, Parameters

logger = logging.getLogger(__name__)
# Keys of what a client keeps in its state between rounds, beside SCAFFOLD's control variate.
MOMENTS = "moments"  # optimiser state
PERSONAL = "own"  # personal parts of the model
LEFT_OVER = "left-over"  # rounding error of its updates so far
PRIVACY = "privacy"  # its releases so far
ALL_RECORDS = (messages.ARRAYS, *messages.EXTRA)  # of arrays, in a message for training
HANDLERS = ("query", "train", "evaluate")  # that mods may be given for; those of secure aggregation are none of them


def build(loaders: Loaders = LOADERS, mods: Mapping[str, Sequence[Mod]] | None = None) -> ClientApp:
    """Return the ClientApp, with handlers for query (statistics), train and evaluate.

    Args:
        mods: Flower's mods by handler, outermost first. Around `train` they get the trained weights; what leaves the
            client is clipped, noised, masked, encoded and signed after them.

    Raises:
        ValueError: mods that are not given by handler.
    """
    around, app = _by_handler(mods), ClientApp()

    @app.query(mods=around["query"])
    def query(message: Message, context: Context) -> Message:
        with _reasons_kept(context):
            note = _introduction(_client(context, loaders), context)
        return Message(RecordDict({messages.NOTE: note}), reply_to=message)

    @app.train(mods=[_released, *around["train"]])
    def train(message: Message, context: Context) -> Message:
        client = _client(context, loaders)
        bundle = _policy(client, message, loaders, context)
        return Message(_trained(client, bundle, message, context), reply_to=message)

    for name, handler in secure_round.HANDLERS.items():
        app.train(name)(handler)

    @app.evaluate(mods=around["evaluate"])
    def evaluate(message: Message, context: Context) -> Message:
        client = _client(context, loaders)
        bundle = _policy(client, message, loaders, context)
        content = _evaluated(client, bundle, message.content[messages.CONFIG][messages.ROUND])
        content[messages.NOTE].update(messages.round_of(message.content))
        return Message(content, reply_to=message)

    return app


def _by_handler(mods: Mapping[str, Sequence[Mod]] | None) -> dict[str, list[Mod]]:
    """Return the mods of every handler; ValueError unless they are given by handler."""
    if mods is not None and not (isinstance(mods, Mapping) and mods.keys() <= set(HANDLERS)):
        raise ValueError(f"mods={mods!r} is not usable: give them by handler ({', '.join(HANDLERS)}), a list for each")
    return {handler: list((mods or {}).get(handler, ())) for handler in HANDLERS}


def _introduction(client: Client, context: Context) -> ConfigRecord:
    """What a client says before training: its number, signed if it has a key, its frames, tasks and statistics."""
    known = {"partition_id": client.partition_id, "num_examples": _weight(client)}
    known["tasks"] = [] if privacy.hides_updates(client.config) else client.tasks
    if key := context.node_config.get(messages.KEY):
        known["signature"] = node_keys.sign(Path(str(key)), context.run_id, context.node_id, client.partition_id)
    asked = normalisation.asks_clients(client.config)
    return messages.make_note(**known, stats=normalisation.pack_stats(client.statistics()) if asked else "")


def _trained(client: Client, bundle: Bundle, message: Message, context: Context) -> RecordDict:
    """Train for one round, save the client's state, and return the content of a reply, which `_released` completes."""
    keeps_moments = client.config.keep_optimizer
    correction = correction_for(message, context, bundle.shared())
    moments = _load_state(context, MOMENTS) if keeps_moments else None
    round_number, second = message.content[messages.CONFIG][messages.ROUND], _sent_second_moments(message, bundle)
    result = client.train(bundle, round_number, correction, moments, second)
    payload = {messages.ARRAYS: bundle.shared_arrays(), **control_variates(correction, context)}
    if result.second_moments:
        payload[messages.SECOND_MOMENTS] = result.second_moments
    metrics = {
        messages.EXAMPLES: _weight(client), messages.STEPS: result.steps, "seconds": result.seconds,
        "loss": sum(result.losses) / len(result.losses),
    }  # fmt: skip
    content = RecordDict({record: messages.pack_arrays(arrays) for record, arrays in payload.items()})
    told = messages.train_metrics(privacy.hides_updates(client.config))
    content[messages.METRICS] = MetricRecord({name: metrics[name] for name in told})
    if keeps_moments:
        context.state[MOMENTS] = messages.pack_arrays(result.moments)
    if bundle.own:
        trained = trainable_arrays(bundle.policy)
        context.state[PERSONAL] = messages.pack_arrays({name: trained[name] for name in bundle.own})
    return content


def _evaluated(client: Client, bundle: Bundle, round_number: int) -> RecordDict:
    examples, metrics = client.validate(bundle)
    with tempfile.TemporaryDirectory() as folder:
        due = measure.rolls_out(client.config, round_number)
        rollouts = rollout_replies.pack_rollouts(client.roll_out(bundle, Path(folder)) if due else [], Path(folder))
    return RecordDict({
        messages.METRICS: MetricRecord({messages.EXAMPLES: examples, **metrics}), messages.NOTE: rollouts,
    })  # fmt: skip


def reserved_gpus() -> list[str]:
    """Return the GPUs that Flower's simulation runtime has reserved for this client; none on other engines."""
    # The runtime's workers have loaded Ray already; elsewhere importing it would only cost time.
    ray = sys.modules.get("ray")
    if ray is None or not ray.is_initialized():
        return []
    return ray.get_runtime_context().get_accelerator_ids().get("GPU", [])


def on_reserved_gpu(config: Config, gpus: Sequence[str]) -> Config:
    """Return the settings with device cuda if a GPU is reserved for the client and they name no other device.

    GPUs are reserved by Flower's connection, which the settings of a run do not know.
    """
    return replace(config, device="cuda") if gpus and config.device == Config.device else config


def _released(message: Message, context: Context, call_next: ClientAppCallable) -> Message:
    """The mod around all others: hide and encode the update as the settings ask, and announce the SHA-256."""
    with _reasons_kept(context):
        reply = call_next(message, context)
        if not reply.has_error():
            _release(reply.content, message, context, from_run_config(context.run_config))
    return reply


def _release(content: RecordDict, message: Message, context: Context, config: Config) -> None:
    """Replace the arrays of a reply by what leaves the client, and add the note of their digests."""
    payload = {record: messages.unpack_arrays(arrays) for record, arrays in content.array_records.items()}
    hides, exchange = privacy.hides_updates(config), config.exchange
    if hides or exchange != "float32":
        start = decode(messages.unpack_arrays(message.content[messages.ARRAYS]), DOWNWARD[exchange])
        hidden = _hidden(payload, start, message, context, config) if hides else payload
        payload = {**hidden, messages.ARRAYS: _outgoing(hidden[messages.ARRAYS], start, exchange, context)}
        for record in list(content.array_records):
            del content[record]
        content.update({record: messages.pack_arrays(arrays) for record, arrays in payload.items()})
    digests = {messages.digest_key(record): digest(arrays) for record, arrays in payload.items()}
    content[messages.NOTE] = ConfigRecord(digests | messages.round_of(message.content))


def _client(context: Context, loaders: Loaders) -> Client:
    config = on_reserved_gpu(from_run_config(context.run_config), reserved_gpus())
    if messages.PARTITION not in context.node_config:
        raise ValueError(f"this node has no {messages.PARTITION}: start it with --node-config 'partition-id=K'")
    own_data = str(context.node_config.get(messages.DATA, ""))
    return open_client(config, int(context.node_config[messages.PARTITION]), loaders, own_data)


def correction_for(message: Message, context: Context, parameters: Parameters) -> Correction | None:
    """Return how the strategy corrects gradients: SCAFFOLD sends control variates, FedProx the weight mu.

    Args:
        parameters: trainable parameters by name, holding the global arrays of the message.

    Raises:
        ParameterError: the control variates are invalid.
    """
    content, shapes = message.content, shapes_of(parameters)
    if messages.CONTROL in content:
        server = messages.checked_arrays(content, messages.CONFIG, shapes, messages.CONTROL, also=ALL_RECORDS)
        return ControlVariates(server, _load_state(context, messages.CONTROL))
    mu = content[messages.CONFIG].get(messages.PROXIMAL_MU, 0.0)
    return Proximal(parameters, mu) if mu else None


def _sent_second_moments(message: Message, bundle: Bundle) -> Arrays:
    """The server's second moments; {} if it sends none. Raise ParameterError if they are invalid."""
    content, record = message.content, messages.SECOND_MOMENTS
    if record not in content:
        return {}
    shapes = shapes_of(bundle.shared())
    arrays = messages.checked_arrays(content, messages.CONFIG, shapes, record, also=ALL_RECORDS)
    return {name: np.maximum(array, 0) for name, array in arrays.items()}


def _outgoing(arrays: Arrays, start: Arrays, exchange: str, context: Context) -> Arrays:
    """Arrays for a reply: the arrays themselves, or the encoded update."""
    if exchange == "float32":
        return arrays
    change = {name: array - start[name] for name, array in arrays.items()}
    encoded, left_over = with_feedback(change, _load_state(context, LEFT_OVER), exchange)
    context.state[LEFT_OVER] = messages.pack_arrays(left_over)
    return encoded


def _hidden(
    payload: privacy.Payload, start: Arrays, message: Message, context: Context, config: Config
) -> privacy.Payload:
    """Return weights and extra records as the server may see them: clipped, and noised or masked."""
    changes = {name: array - start[name] for name, array in payload[messages.ARRAYS].items()}
    payload = {**payload, messages.ARRAYS: changes}
    _spend(config, context, sum(array.size for arrays in payload.values() for array in arrays.values()))
    round_number, who = message.content[messages.CONFIG][messages.ROUND], int(context.node_config[messages.PARTITION])
    payload = privacy.from_client(payload, config, round_number, who)
    if config.secure_aggregation:
        return {messages.ARRAYS: secure_round.masked_update(payload, message, context, config)}
    ends = {name: start[name] + change for name, change in payload[messages.ARRAYS].items()}
    return {**payload, messages.ARRAYS: ends}


def _spend(config: Config, context: Context, size: int) -> None:
    """Count a release of this client's, which does not trust the server's count; raise ValueError over budget."""
    releases = 1 + int(_load_state(context, PRIVACY).get("releases", 0))
    if privacy.is_private(config) and config.epsilon_budget and config.noise_by != "server":
        if (spent := accountant.epsilon(config, releases, size)) > config.epsilon_budget:
            raise ValueError(f"this client's release {releases} would make epsilon {spent:.3g}: its budget is spent")
    context.state[PRIVACY] = messages.pack_arrays({"releases": np.array(releases)})


@contextmanager
def _reasons_kept(context: Context) -> Iterator[None]:
    """Keep the text of an error, which may tell of the data, from a server that must not see updates either."""
    try:
        yield
    except Exception:
        if not privacy.hides_updates(from_run_config(context.run_config)):
            raise
        logger.exception("this client failed")
        raise RuntimeError("this client failed; the reason is in its own log") from None


def _weight(client: Client) -> int:
    """A client's weight in the average: its frames, or 1 if all count alike."""
    return 1 if privacy.weighs_alike(client.config) else client.num_examples


def control_variates(correction: Correction | None, context: Context) -> dict[str, Arrays]:
    """Return the change of SCAFFOLD's control variate as a record, and save the new one in the client's state."""
    if not isinstance(correction, ControlVariates):
        return {}
    change = correction.change()
    context.state[messages.CONTROL] = messages.pack_arrays(correction.updated())
    return {messages.CONTROL: change}


def _load_state(context: Context, what: str) -> Arrays:
    """Arrays that this client saved in an earlier round; {} if there are none."""
    return messages.unpack_arrays(context.state[what]) if what in context.state else {}


def _policy(client: Client, message: Message, loaders: Loaders, context: Context) -> Bundle:
    """Return the policy with the checked global arrays of the message and the client's personal parts."""
    content, config = message.content, client.config
    bundle = loaders.load_policy(config, _statistics(client, content[messages.CONFIG]))
    shapes, exchange = shapes_of(bundle.shared()), DOWNWARD[config.exchange]
    arrays = messages.checked_arrays(content, messages.CONFIG, shapes, also=ALL_RECORDS, exchange=exchange)
    load_arrays(bundle.policy, arrays | (_load_state(context, PERSONAL) or bundle.own))
    return bundle


def _statistics(client: Client, said: ConfigRecord) -> normalisation.Stats:
    """Return what to normalise with; ValueError if the server should have sent it, and is one that sends none."""
    config = client.config
    if config.normalisation == "own":
        return client.statistics()
    if messages.STATS in said:
        return normalisation.unpack_stats(said[messages.STATS])
    if normalisation.asks_clients(config):
        raise ValueError(
            f"normalisation={config.normalisation!r} needs the statistics that a server of this library pools and "
            "sends: give normalisation=base, own or none with another server"
        )
    return normalisation.common_statistics(config, {})


app = build(WORKER_LOADERS)
