"""Command ``h3data serve``, which serves a policy of this package over a WebSocket."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import InputError
from h3data.progress import say


@dataclass(frozen=True, kw_only=True)
class Serve:
    """Serve a policy over a websocket, in the protocol of openpi.

    Planners observe the whole state, which only h3data can send. Trained policies and those with --adapter receive
    named observations, which any client can send. Ctrl-C stops the server. Needs the extra remote.

    Examples:
        h3data serve --policy rollout_expert
        h3data serve --policy end_to_end --port 8001
        h3data serve --policy my_module:policy --adapter mine.toml
    """

    policy: str
    """Policy of the robot: a name as in generate, weights:FILE or module:name."""
    task: str | None = None
    """Task of the policy: wander, or an installed task whose robots drive (default: social_nav)."""
    adapter: Path | None = None
    """Adapter file with the observations that clients send (h3data docs remote-policies)."""
    host: Annotated[
        str, tyro.conf.arg(help="Address to listen on; others than this machine's own have no protection.")
    ] = "127.0.0.1"
    port: Annotated[int, tyro.conf.arg(help="Port to listen on; 0 is any free one.")] = 8000
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Serve until Ctrl-C."""
        if not 0 <= self.port < 65536:
            raise InputError(f"Expected a --port from 0 to 65535, got {self.port}.", code="H3-REMOTE-013")
        from h3data_remote.adapter import read_adapter
        from h3data_remote.serving import ServedPolicy, policy_service

        chosen = read_adapter(str(self.adapter)) if self.adapter is not None else None
        served = ServedPolicy(self.policy, self.task, chosen)
        with policy_service(served, self.host, self.port) as server:
            host, port = server.socket.getsockname()[:2]
            say(f"{self.policy} is at ws://{f'[{host}]' if ':' in host else host}:{port}. Ctrl-C ends it.")
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                server.shutdown()
        return Outcome(text="The server has ended.", data={"host": host, "port": port})
