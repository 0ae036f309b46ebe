"""Policy servers for tests: in openpi's protocol and in GR00T's, with a function that answers, or that misbehaves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import zmq
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from h3data.policies import Velocity
from h3data_remote.wire import GROOT, OPENPI

BREAK_OFF = object()
"""An answer that is none: the server ends the conversation."""


@contextmanager
def websocket_server(handle: Callable[[ServerConnection], object]) -> Iterator[str]:
    """Address of a server that does this with every connection."""

    def guarded(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            handle(connection)

    with serve(guarded, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=0.2) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join()


def answering(
    answer: Callable[[dict[str, Any]], Any], metadata: dict[str, Any] | None = None
) -> Callable[[ServerConnection], None]:
    """Greets, then answers each request; bytes and text go out as they are, and `BREAK_OFF` ends the connection."""

    def handle(connection: ServerConnection) -> None:
        connection.send(OPENPI.pack(metadata or {}))
        while True:
            found = answer(OPENPI.unpack(bytes(connection.recv())))
            if found is BREAK_OFF:
                raise ConnectionResetError
            connection.send(found if isinstance(found, bytes | str) else OPENPI.pack(found))

    return handle


@contextmanager
def groot_server(act: Callable[[dict[str, Any]], Any], asked: list[str] | None = None) -> Iterator[str]:
    """Address of a server with GR00T's endpoints, whose ``get_action`` answers ``[act(observation), {}]``."""
    context, stop = zmq.Context(), threading.Event()
    sock = context.socket(zmq.REP)
    port = sock.bind_to_random_port("tcp://127.0.0.1")

    def run() -> None:
        nonlocal sock
        while not stop.is_set():
            if not sock.poll(20):
                continue
            request = GROOT.unpack(sock.recv())
            endpoint = request["endpoint"]
            (asked if asked is not None else []).append(endpoint)
            if endpoint == "get_action":
                answer = act(request["data"]["observation"])
                if answer is BREAK_OFF:
                    sock.close(linger=0)
                    sock = context.socket(zmq.REP)
                    while True:  # the old socket lets go of its port a moment later
                        with suppress(zmq.ZMQError):
                            sock.bind(f"tcp://127.0.0.1:{port}")
                            break
                        time.sleep(0.01)
                    continue
                sock.send(answer if isinstance(answer, bytes) else GROOT.pack(answer))
            else:
                sock.send(GROOT.pack({"status": "ok"} if endpoint == "ping" else {}))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield f"zmq://127.0.0.1:{port}"
    stop.set()
    thread.join()
    sock.close(linger=0)
    context.term()


# --- a policy ---------------------------------------------------------------------------------------------------------
def steer(gps: Any) -> tuple[float, float]:
    """Forward and turn of a robot that follows a person at this distance [m] and angle [rad]."""
    distance, angle = (float(value) for value in gps)
    forward = float(np.clip((distance - 1.5) * 0.8, -1, 1)) if abs(angle) < 0.6 else 0.1
    return forward, float(np.clip(-2 * angle, -1, 1))


def follow(view: Any, base: Any) -> Velocity:
    """The same as a policy in process."""
    del base
    forward, turn = steer(view.observe(["humanoid_gps"])["humanoid_gps"])
    return Velocity(forward, turn, "follow" if view.met else "find")


def followed(request: dict[str, Any]) -> dict[str, Any]:
    """The same as an answer."""
    return {"actions": np.array([steer(request["humanoid_gps"])])}
