"""A ClientApp that fails on the way: in round 1 client 0 raises, in round 2 client 1 sends NaN.

Tests put this file into the app that Flower's engines run, and pass its app to the inline engine.
"""

import numpy as np

from fedvla_lib.federation import client_app, messages


def fault(message, context, call_next):
    """Around the training of a client, before what it sends is signed."""
    reply, who = call_next(message, context), context.node_config[messages.PARTITION]
    match message.content[messages.CONFIG][messages.ROUND], who:
        case 1, 0:
            raise OSError("no space left on device")
        case 2, 1:
            trained = messages.unpack_arrays(reply.content[messages.ARRAYS])
            arrays = {name: array * np.float32("nan") for name, array in trained.items()}
            reply.content[messages.ARRAYS] = messages.pack_arrays(arrays)
    return reply


app = client_app.build(mods={"train": [fault]})
