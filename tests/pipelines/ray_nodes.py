"""A Ray cluster of several nodes on this machine, whose nodes can be killed: ``python -m tests.pipelines.ray_nodes 3``.

It lives in a process of its own, which is told what to do line by line: Ray starts nodes in main threads only.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def serve(count: int) -> None:
    """A head without CPUs and ``count`` nodes of one CPU each. The line ``3`` kills node 3 and adds another."""
    from ray.cluster_utils import Cluster

    memory = {"object_store_memory": 200 << 20}
    cluster: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **memory})
    nodes = [cluster.add_node(num_cpus=1, **memory) for _ in range(count)]
    sys.stdout.write(f"cluster {cluster.address}\n")
    sys.stdout.flush()
    for line in sys.stdin:
        cluster.remove_node(nodes[int(line)], allow_graceful=False)  # as a power cut would
        nodes[int(line)] = cluster.add_node(wait=False, num_cpus=1, **memory)  # on a busy machine it takes a minute
        sys.stdout.write("replaced\n")
        sys.stdout.flush()
    cluster.shutdown()


class Nodes:
    """The cluster as tests see it."""

    def __init__(self, count: int) -> None:
        self.count, self.killed = count, 0
        environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.pipelines.ray_nodes", str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        self.address = self._said("cluster ")

    def replace(self, which: int) -> None:
        """Kills a node and adds another."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{which}\n")
        self.process.stdin.flush()
        self._said("replaced")
        self.killed += 1

    def _said(self, beginning: str) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(beginning):
                return line.removeprefix(beginning).strip()
        raise RuntimeError("The cluster ended.")


@contextmanager
def ray_nodes(count: int) -> Iterator[Nodes]:
    """A cluster that RAY_ADDRESS names."""
    before = os.environ.get("RAY_ADDRESS")
    nodes = Nodes(count)
    os.environ["RAY_ADDRESS"] = nodes.address
    try:
        yield nodes
    finally:
        os.environ.pop("RAY_ADDRESS")
        if before is not None:
            os.environ["RAY_ADDRESS"] = before
        nodes.process.communicate(timeout=120)  # the end of its input ends it


@contextmanager
def killing(nodes: Nodes, *, every_s: float, most: int, seed: int = 0) -> Iterator[None]:
    """Kills a random node every few seconds while the block runs."""
    over, chance = threading.Event(), random.Random(seed)

    def kill() -> None:
        while nodes.killed < most and not over.wait(every_s):
            nodes.replace(chance.randrange(nodes.count))

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield
    finally:
        over.set()
        killer.join()


if __name__ == "__main__":
    serve(int(sys.argv[1]))
