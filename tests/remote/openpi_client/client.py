"""Run by Python with openpi's own client: drives a server of ours, or serves a policy in its codec, and prints JSON.

client.py drive PORT       40 steps in chunks of 4, then a request that must fail
client.py serve            prints a port, then answers with chunks of 5 as openpi's server does
client.py pack             prints the bytes of an observation, as hexadecimal digits
"""

from __future__ import annotations

import json
import sys

import numpy as np
from openpi_client import action_chunk_broker, image_tools, msgpack_numpy, websocket_client_policy


def observation() -> dict:
    """The same array, text and numbers at every call."""
    picture = image_tools.resize_with_pad(np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3), 224, 224)
    return {
        "observation/image": np.ascontiguousarray(picture),
        "observation/state": np.linspace(-1, 1, 7),
        "n": [np.float32(0.5), np.int64(3), 7, 0.25, None],
        "prompt": "follow the person",
    }


def drive(port: int) -> None:
    client = websocket_client_policy.WebsocketClientPolicy("127.0.0.1", port)
    hold = client.get_server_metadata()["h3data"]["adapter"].get("hold", 1)
    broker = action_chunk_broker.ActionChunkBroker(client, action_horizon=hold)
    actions = [
        broker.infer({"humanoid_gps": np.array([3.0, 0.02 * k], np.float32)})["actions"].tolist() for k in range(8)
    ]
    try:
        client.infer({"nothing": 1})
        fault = ""
    except RuntimeError as error:
        fault = str(error)
    print(json.dumps({"metadata": client.get_server_metadata(), "actions": actions, "fault": fault}))


def serve() -> None:
    import websockets.sync.server

    def handle(connection: websockets.sync.server.ServerConnection) -> None:
        packer = msgpack_numpy.Packer()
        connection.send(packer.pack({"name": "fake pi", "scale": np.float32(0.5)}))
        for packed in connection:
            seen = msgpack_numpy.unpackb(packed)
            distance, angle = (float(x) for x in seen["observation/state"][:2])
            row = [min(max((distance - 1.5) * 0.8, -1.0), 1.0), min(max(-2 * angle, -1.0), 1.0)]
            answer = {"actions": np.tile(np.array(row, np.float32), (5, 1)), "server_timing": {"infer_ms": 1.0}}
            answer["seen"] = [list(seen["observation/image"].shape), seen["prompt"]]
            connection.send(packer.pack(answer))

    with websockets.sync.server.serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        print(server.socket.getsockname()[1], flush=True)
        server.serve_forever()


if __name__ == "__main__":
    if sys.argv[1] == "drive":
        drive(int(sys.argv[2]))
    elif sys.argv[1] == "serve":
        serve()
    else:
        print(msgpack_numpy.Packer().pack(observation()).hex())
