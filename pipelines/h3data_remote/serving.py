"""Server for policies of this package with openpi's protocol, for tests, demonstrations and other simulators."""

from __future__ import annotations

import http
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data_remote.adapter import Adapter, Entry
from h3data_remote.policy import OWN
from h3data_remote.privileged import unpacked_episode, view_from_wire
from h3data_remote.wire import MISSING, MOST_BYTES, OPENPI, PolicyServerError
from sim_kinematic.policies.assignment import as_policy, is_address, plugin_policies, policy_names, resolve_policy
from sim_kinematic.policies.learned import LearnedNavigation, VisualNavigation, is_learned, network_of
from sim_kinematic.policies.network import Network
from sim_kinematic.policies.policy import FunctionPolicy
from sim_kinematic.policies.visual_policy import VisualPolicy
from sim_kinematic.sensing.agent_pictures import DETECTORS
from sim_kinematic.sensing.table import TABLE
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.social_nav import SocialNav

try:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import Server, ServerConnection, serve
except ImportError as error:
    raise MissingExtraError(MISSING, code="H3-REMOTE-042") from error

MOST_SESSIONS = 256
"""Largest number of episodes that clients play at the same time; above it, the longest idle one is dropped."""
log = logging.getLogger("h3data.remote")


class ObservedView:
    """View of a request, for a policy that decides by named observations."""

    met = False

    def __init__(self, entries: Mapping[str, Any], step: int) -> None:
        self._entries, self.step, self.seed = entries, step, int(entries.get("h3data/seed", 0))

    def observe(self, names: tuple[str, ...], size: Any = None, light: str = "flat") -> dict[str, NDArray[Any]]:
        """Return the observations with these names.

        Raises:
            PolicyServerError: the request lacks an observation.
        """
        lacks = [name for name in names if name not in self._entries]
        if lacks:
            raise PolicyServerError(
                f"The request lacks: {', '.join(lacks)}. The metadata say what to send.", code="H3-REMOTE-044"
            )
        shown = {name: np.asarray(self._entries[name]) for name in names}
        strange = [name for name, values in shown.items() if values.dtype.kind not in "biuf" or not values.ndim]
        if strange:
            raise PolicyServerError(
                f"Expected arrays of numbers, got something else in: {', '.join(strange)}.", code="H3-REMOTE-060"
            )
        return shown

    def __getattr__(self, name: str) -> Any:
        raise PolicyServerError(
            f"The policy asks for {name!r}, which named observations do not tell. Hint: h3data serve without --adapter.",
            code="H3-REMOTE-043",
        )


class _ServedNavigation(LearnedNavigation):
    """A network without pictures, by named observations."""

    def look(self, view: Any, spec: Any) -> NDArray[np.float32]:
        shown = view.observe(self.network.observations)
        return np.concatenate([np.ravel(values) for values in shown.values()]).astype(np.float32)


class _ServedVisualNavigation(VisualNavigation):
    """A network with pictures, by named observations."""

    def look(self, view: Any, spec: Any) -> dict[str, NDArray[Any]]:
        return view.observe(self.network.card.observations)


class ServedPolicy:
    """Policy on a server, with its metadata and a new player for each episode."""

    def __init__(self, name: str, task: str | None = None, adapter: Adapter | None = None) -> None:
        """Find the policy with a name.

        Args:
            name: Name as for ``--policy``: a planner, a trained policy, ``weights:FILE``, or ``module:name``.
            task: Task that is played; None for social navigation.
            adapter: Adapter of clients; None selects a network's training inputs, or else the whole view, which only
                h3data can send.

        Raises:
            InputError: there is no such policy, or it does not move a base.
        """
        self.task, self.name, self._network = find_task(task or SocialNav), name, None
        if is_address(name):
            raise InputError(
                "Expected a policy of this machine to serve, got the address of a server.", code="H3-REMOTE-045"
            )
        if self.task.control.has_skills:
            raise InputError(
                f"Expected a task whose robots drive, such as social_nav, got {self.task.name}, whose policies choose skills.",
                code="H3-REMOTE-046",
            )
        resolve_policy(self.task, "robot", name, self.task.Spec())
        self.view = False
        if is_learned(name):
            network = network_of(name)
            assert isinstance(network, Network | VisualPolicy)
            self._network, adapter = network, adapter_of_network(network)
        elif adapter is None:
            self.view, adapter = True, Adapter(session=True)
        self.adapter = adapter

    def metadata(self) -> dict[str, Any]:
        """Return the metadata that each connection receives first."""
        short = self.name.rpartition("/")[2].rpartition(":")[2]
        own = {"name": short, "adapter": msgspec.to_builtins(self.adapter), "batch": True, "view": self.view}
        return {"policy": short, "task": self.task.name, OWN: own}

    def player(self) -> _Player:
        """Return the player that answers the requests of one episode."""
        return _Player(self)

    def fresh(self, episode: Episode | None, number: int) -> Any:
        """Return a policy for an episode, or one that uses named observations if there is no episode.

        Raises:
            InputError: the policy needs an episode.
        """
        spec = self.task.Spec()
        if isinstance(self._network, VisualPolicy):
            return FunctionPolicy(_ServedVisualNavigation(self._network), spec.robot)
        if self._network is not None:
            return FunctionPolicy(_ServedNavigation(self._network), spec.robot)
        if episode is not None:
            return resolve_policy(self.task, "robot", self.name)(episode, number).policy
        if self.name in policy_names(self.task, "robot"):
            raise InputError(
                f"The policy {self.name} needs to know the map. Hint: h3data serve without --adapter.",
                code="H3-REMOTE-047",
            )
        found: Any = plugin_policies().get(self.name)
        code = getattr(found, "__code__", None)
        if code is not None and code.co_argcount == 2:
            return FunctionPolicy(found, spec.robot)
        return as_policy(found, self.task, None, number)  # type: ignore[arg-type]  # classes and policies need no episode


def adapter_of_network(network: Network | VisualPolicy) -> Adapter:
    """Return the adapter for clients of a network: the observations and sizes with which it was trained."""
    if isinstance(network, VisualPolicy):
        card = network.card
        drawn = [name for name in card.observations if name not in TABLE or name in DETECTORS]
        entries = {name: Entry(name, card.picture_size if name in drawn else None) for name in card.observations}
        return Adapter(observation=entries, light=card.light, session=True, hold=card.hold)
    return Adapter(observation={name: Entry(name) for name in network.observations}, session=True)


class _Player:
    """Player of one episode, which answers its requests."""

    def __init__(self, served: ServedPolicy) -> None:
        self._served, self._policy, self._episode, self._calls = served, None, None, 0

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        served, hold = self._served, self._served.adapter.hold
        step = request.get("h3data/step", self._calls * hold)
        if request.get("h3data/reset") is True:
            self._policy = None
        number = request.get("h3data/agent", 0)
        if not isinstance(step, int) or not isinstance(number, int):
            raise PolicyServerError("Expected whole numbers in h3data/step and h3data/agent.", code="H3-REMOTE-048")
        if self._policy is None:
            self._episode = unpacked_episode(served.task, request.get("h3data/episode")) if served.view else None
            self._policy = served.fresh(self._episode, number)
        self._calls += 1
        view = (
            ObservedView(request, step)
            if self._episode is None
            else view_from_wire(request.get("h3data/view"), self._episode, number)
        )
        choice = self._policy.act(view)
        if not hasattr(choice, "forward"):
            raise PolicyServerError(
                f"The policy chooses {type(choice).__name__}, which this protocol does not carry.", code="H3-REMOTE-049"
            )
        actions = np.tile(np.array([[choice.forward, choice.turn]], np.float32), (hold, 1))
        return {"actions": actions, "h3data/skill": getattr(choice, "skill", "")}


# --- the server -------------------------------------------------------------------------------------------------------
def policy_service(served: ServedPolicy, host: str = "127.0.0.1", port: int = 8000) -> Server:
    """Return a listening server, with ``serve_forever()`` to run it and ``shutdown()`` to end it.

    Each connection is a separate conversation. Browsers are refused, because pages of other sites could send requests.

    Raises:
        InputError: the port is in use, or the address is not one of this machine.
    """
    metadata, sessions = OPENPI.pack(served.metadata()), Sessions(served)

    def handle(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            _converse(connection, sessions, metadata)

    try:
        return serve(
            handle,
            host,
            port,
            compression=None,
            max_size=MOST_BYTES,
            process_request=_health,
            # only browsers send an Origin
            origins=[None],
            # clients like ours read only while they wait for an answer; between two they may simulate for longer than 20 s
            ping_timeout=None,
        )
    except OSError as fault:
        raise InputError(
            f"No server can listen at {host}:{port}: {fault.strerror or fault}.", code="H3-REMOTE-050"
        ) from None


def _health(connection: ServerConnection, request: Any) -> Any:
    return connection.respond(http.HTTPStatus.OK, "OK\n") if request.path == "/healthz" else None


class Sessions:
    """Episodes that clients play, by the names that clients give them, independent of connections."""

    def __init__(self, served: ServedPolicy) -> None:
        self._served, self._lock = served, threading.Lock()
        self._players: OrderedDict[str, _Player] = OrderedDict()

    def player(self) -> _Player:
        """Return the player that answers the requests of a new episode."""
        return self._served.player()

    def answer(self, request: Any, nameless: _Player) -> dict[str, Any]:
        """Return the answer to a request; ``nameless`` plays the episode of a client that gives no names."""
        if not isinstance(request, dict):
            raise PolicyServerError(
                f"Expected a map of observations, got {type(request).__name__}.", code="H3-REMOTE-051"
            )
        session = request.get("h3data/session")
        if not isinstance(session, str):
            return nameless.answer(request)
        with self._lock:
            player = self._players[session] = self._players.pop(session, None) or self._served.player()
            while len(self._players) > MOST_SESSIONS:
                self._players.popitem(last=False)
        return player.answer(request)


def _converse(connection: ServerConnection, sessions: Sessions, metadata: bytes) -> None:
    """Answer one client until it leaves, or send what cannot be answered."""
    connection.send(metadata)
    nameless, total_ms = sessions.player(), None
    while True:
        packed = connection.recv()
        begun = time.perf_counter()
        try:
            if isinstance(packed, str):
                raise PolicyServerError("Expected a MessagePack message, got text.", code="H3-REMOTE-052")
            request = OPENPI.unpack(packed)
            batch = request.get("batch") if isinstance(request, dict) else None
            found = (
                {"batch": [sessions.answer(one, nameless) for one in batch]}
                if isinstance(batch, list)
                else sessions.answer(request, nameless)
            )
        except Exception as fault:  # as openpi's: the fault in a text frame, then the end
            if not isinstance(fault, H3DataError):
                log.exception("a request failed")
            connection.send(str(fault) if isinstance(fault, H3DataError) else f"{type(fault).__name__}: {fault}")
            connection.close(1011, "The fault is in the frame before.")
            return
        timing = {"infer_ms": (time.perf_counter() - begun) * 1e3}
        if total_ms is not None:
            timing["prev_total_ms"] = total_ms
        connection.send(OPENPI.pack({**found, "server_timing": timing}))
        total_ms = (time.perf_counter() - begun) * 1e3
