"""CPU time that a request to a policy server costs the process that asks, beyond the same policy in process."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from h3data import session
from h3data_remote.adapter import Adapter, Entry
from h3data_remote.wire import OPENPI
from sim_kinematic.policies.assignment import make_policy
from sim_kinematic.tasks.registry import find_task

CALLS = 50
BATCHES = 6
"""Of which the fastest counts: other programs on the machine make the caches of all others cold."""
SERVER = """
import sys
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve
from h3data_remote.wire import OPENPI

greeting, answer = OPENPI.pack(OPENPI.unpack(bytes.fromhex(sys.argv[1]))), OPENPI.pack({"actions": np.zeros((1, 2))})

def handle(connection):
    connection.send(greeting)
    try:
        while True:
            connection.recv()
            connection.send(answer)
    except ConnectionClosed:
        pass

with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
    print(server.socket.getsockname()[1], flush=True)
    server.serve_forever()
"""


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit ``remote.*``: whole calls (observe, pack, send, wait, unpack, check), and the part of the wire."""
    numbers = {name: Entry(name) for name in ("humanoid_gps", "egomotion")}
    pictures = {"image": Entry("arm_rgb", (224, 224)), "depth": Entry("arm_depth", (224, 171))}
    for name, shown in (("numbers", numbers), ("pictures", {**numbers, **pictures})):
        whole_ms, wire_ms = _costs(Adapter(observation=shown, prompt="prompt", session=True))
        emit(f"remote.{name}_call_cpu_ms", whole_ms, "ms")
        emit(f"remote.{name}_wire_cpu_ms", wire_ms, "ms")


def _costs(adapter: Adapter) -> tuple[float, float]:
    """CPU time of this process for a call, and for its part after the observation was made: least of medians [ms]."""
    import subprocess
    import sys

    import msgspec

    greeting = OPENPI.pack({"h3data": {"adapter": msgspec.to_builtins(adapter)}}).hex()
    process = subprocess.Popen([sys.executable, "-c", SERVER, greeting], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = f"ws://127.0.0.1:{int(process.stdout.readline())}"
        game = session("social_nav", "small:3", agents={"robot": "still"})
        policy = make_policy(find_task("social_nav"), game.episode, 0, address).policy
        whole, wire = [], []
        for _ in range(CALLS * BATCHES):
            game.step()
            view = game.observe("robot")
            begun = time.process_time()
            request = policy.request(view)
            shown = time.process_time()
            policy.choice(policy.fetch(request)[0], view)
            ended = time.process_time()
            whole.append(ended - begun)
            wire.append(ended - shown)
        medians = np.median(np.reshape([whole, wire], (2, BATCHES, CALLS)), axis=-1).min(-1) * 1e3
        return float(medians[0]), float(medians[1])
    finally:
        process.kill()
        process.wait()
