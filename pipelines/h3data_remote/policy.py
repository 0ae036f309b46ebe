"""Remote policy of a robot, selected by ``--policy ws://host:port`` or ``--policy zmq://host:port``."""

from __future__ import annotations

import hashlib
import re
import time
import uuid
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data_remote.adapter import DEFAULTS, Adapter, Observer, adapter_of, chunk_of, nested, read_adapter
from h3data_remote.background import BackgroundPolicy
from h3data_remote.connections import Address, Connection, connect
from h3data_remote.privileged import packed_episode, view_to_wire
from h3data_remote.wire import PolicyServerError
from sim_kinematic.agents.skills import CONTROL, Action
from sim_kinematic.policies.assignment import AssignedPolicy, PolicyMaker
from sim_kinematic.policies.policy import Velocity

OWN = "h3data"
"""Key in a server's metadata with facts for h3data: ``name``, ``adapter``, ``batch``, ``view``."""
MOST_METADATA = 4096
"""Largest size of a server's metadata, as JSON, that is recorded [bytes]; of larger metadata only the digest is
recorded."""
_ANSWERED: set[str] = set()
"""Servers that have answered this process before, so that they have already compiled."""


def policy_server(address: str, task: Any, kind: str, spec: Any = None) -> PolicyMaker:
    """Return a factory of a server's policy for an episode (the entry points ``ws``, ``wss`` and ``zmq``).

    Args:
        address: Address of the server, as read by `Address.of`.
        task: Task that is played.
        kind: Kind of the agent.
        spec: Rules of the task if a job is checked before it starts, which requires that the server is available.

    Raises:
        InputError: the address is invalid, there is no such adapter, or the agent is not a robot.
        PolicyServerError: the server does not answer.
    """
    if kind != "robot":
        raise InputError(
            f"Policy servers move robots; a {kind} of {task.name} needs another policy.", code="H3-REMOTE-033"
        )
    where = Address.of(address)
    chosen = read_adapter(where.adapter) if where.adapter else None

    def made(episode: Any, number: int) -> AssignedPolicy:
        policy = RemotePolicy(where, chosen, task, episode, number)
        return AssignedPolicy(policy, policy.name, kind)

    if spec is not None:
        connection = connect(where)
        try:
            adapter_for(connection, where, chosen)
        finally:
            connection.close()
    return made


def adapter_for(connection: Connection, where: Address, chosen: Adapter | None) -> Adapter:
    """Return the adapter chosen by the user, else that of the server, else the default of its protocol.

    Raises:
        InputError: the adapter of the server is malformed.
    """
    if chosen is not None:
        return chosen
    own = own_facts(connection.metadata)
    if "adapter" in own:
        return adapter_of(own["adapter"], f"The adapter of the policy server at {where}")
    return read_adapter(DEFAULTS[where.scheme])


def own_facts(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the facts for h3data in a server's metadata; empty for servers of other software."""
    own = metadata.get(OWN)
    return own if isinstance(own, dict) else {}


class RemotePolicy:
    """Policy that requests chunks of a robot's actions from a server and carries them out step by step.

    Each episode has its own connection, by which servers know that a new episode starts.
    """

    is_remote = True
    """True, so that a replay repeats the recorded actions without asking the policy
    (`sim_kinematic.policies.recorded`)."""

    def __init__(self, where: Address, chosen: Adapter | None, task: Any, episode: Any, number: int) -> None:
        """Connect to the server.

        Args:
            where: Address of the server.
            chosen: Adapter; None selects the server's adapter, or the default.
            task: Task that is played.
            episode: Episode that is played.
            number: Number of the robot among the agents.

        Raises:
            PolicyServerError: there is no answer, or it is not that of a policy server.
            InputError: the adapter does not fit the robot or the task.
        """
        self.where, self._chosen, self._batched = where, chosen, where.scheme == "zmq"
        self._body = body = episode.roster[number].body
        self._seed, self._instruction = int(episode.seed), task.codec.instruction(episode)
        self._with_objects = task.control.has_skills
        self._task, self._episode, self._number, self._session = task, episode, number, uuid.uuid4().hex
        self._connect()
        adapter = self.adapter
        self._arm = len(body.require_arm()) + 1 if self._with_objects else 0
        if adapter.action == "control" and not self._with_objects:
            raise InputError(
                f"The adapter {adapter.name} moves an arm (action = control), for which {task.name} has no use. "
                "Expected: base.",
                code="H3-REMOTE-034",
            )
        self.width = 2 + self._arm * (adapter.action == "control")
        """Numbers of one action."""
        self._shows_view = own_facts(self.connection.metadata).get("view") is True
        if self._shows_view and self._with_objects:
            raise InputError(
                f"The policy at {where} is for bases that drive; {task.name} has objects to bring as well.",
                code="H3-REMOTE-035",
            )
        self._observer = Observer(adapter, body, batched=self._batched)
        self.name = _name(self.connection.metadata, adapter, where)
        """Name in recordings: protocol, name and a digest of metadata and adapter, and no address."""
        self._rows: deque[NDArray[np.float32]] = deque()
        self._step, self._skill, self._skills = -1, "", task.control.skills.get("robot", ())
        self._waits: list[float] = []
        self._infers: list[float] = []

    def _connect(self) -> None:
        self.connection: Connection = connect(self.where)
        self._is_new = True
        self._closing = weakref.finalize(self, self.connection.close)
        self.adapter = adapter_for(self.connection, self.where, self._chosen)

    def reconnect(self) -> None:
        """Start a new conversation after one that failed.

        Raises:
            PolicyServerError: the server does not answer.
        """
        self.close()
        self._connect()

    def close(self) -> None:
        """End the conversation; this happens automatically when the policy is no longer used."""
        self._closing()

    # --- one decision -------------------------------------------------------------------------------------------------
    def act(self, view: Any) -> Velocity | Action:
        """Return the next action of the current chunk, or of a new chunk if it is used up or steps were skipped.

        Raises:
            PolicyServerError: the server does not answer in time, or its answer is not a chunk.
        """
        # steps were repeated from a recording meanwhile, so that what is left of the chunk was meant for another moment
        if view.step != self._step + 1:
            self._rows.clear()
        self._step = view.step
        if not self._rows:
            self._rows.extend(self.fetch(self.request(view)))
        return self.choice(self._rows.popleft(), view)

    def request(self, view: Any) -> dict[str, Any]:
        """Return the request for the current step."""
        adapter = self.adapter
        entries = self._observer.observation(view)
        if adapter.prompt:
            entries[adapter.prompt] = [[self._instruction]] if self._batched else self._instruction
        if adapter.session:
            entries |= {
                "h3data/seed": self._seed,
                "h3data/step": int(view.step),
                "h3data/reset": self._is_new,
                "h3data/session": self._session,
            }
        if self._shows_view:
            if self._is_new:
                entries["h3data/episode"] = packed_episode(self._task, self._episode)
            entries |= {"h3data/agent": self._number, "h3data/view": view_to_wire(view)}
        self._is_new = False
        return nested(entries) if self._batched else entries

    def fetch(self, request: dict[str, Any]) -> NDArray[np.float32]:
        """Return the actions of the server's answer, shape [hold, width].

        Raises:
            PolicyServerError: the server does not answer in time, or the actions are of the wrong kind.
        """
        server = str(self.where)
        # a model is compiled at its first request, which takes minutes; that is per server and not per connection
        timeout_s = self.adapter.timeout_s if server in _ANSWERED else self.adapter.first_timeout_s
        begun = time.perf_counter()
        answer = self.connection.ask(request, timeout_s)
        self._waits.append((time.perf_counter() - begun) * 1e3)
        _ANSWERED.add(server)
        # the text is recorded as the name of a skill, so none of a server's own invention is taken
        said = answer.get("h3data/skill")
        self._skill = said if said in self._skills else ""
        timing = answer.get("server_timing")
        if isinstance(timing, dict) and isinstance(timing.get("infer_ms"), int | float):
            self._infers.append(float(timing["infer_ms"]))
        try:
            return chunk_of(answer, self.adapter, self.width, server, batched=self._batched)
        except PolicyServerError:
            self.close()  # no later answer of it is trusted
            raise

    def choice(self, row: NDArray[np.float32], view: Any) -> Velocity | Action:
        """Return the choice in the task for one action [width]."""
        if self._with_objects:
            rest = [] if len(row) > 2 else [0.0] * self._arm
            return Action(CONTROL, command=(*map(float, row), *rest))
        return Velocity(float(row[0]), float(row[1]), self._skill or _usual_skill(view))

    # --- several worlds -----------------------------------------------------------------------------------------------
    @property
    def takes_batches(self) -> bool:
        """Return whether the server can answer for several worlds at once."""
        return self._batched or own_facts(self.connection.metadata).get("batch") is True

    @staticmethod
    def act_together(policies: Sequence[RemotePolicy], views: Sequence[Any]) -> list[Velocity | Action]:
        """Return the actions of several policies of one server, with one request for all used-up chunks.

        Servers without batches are asked for each policy in turn.

        Raises:
            PolicyServerError: as in `act`.
        """
        first = policies[0]
        asking = [
            k for k, (p, v) in enumerate(zip(policies, views, strict=True)) if not p._rows or v.step != p._step + 1
        ]
        if len(asking) > 1 and first.takes_batches:
            requests = [policies[k].request(views[k]) for k in asking]
            for k, chunk in zip(asking, first._fetch_batch(requests), strict=True):
                policies[k]._rows = deque(chunk)
                # as if it had acted in the step before, so that `act` takes the first row of this chunk
                policies[k]._step = views[k].step - 1
                if policies[k] is not first:
                    policies[k]._waits.append(first._waits[-1])
        return [policy.act(view) for policy, view in zip(policies, views, strict=True)]

    def _fetch_batch(self, requests: Sequence[dict[str, Any]]) -> list[NDArray[np.float32]]:
        """Return the chunks of several requests, which go out as one: along the axis of worlds, or as a list."""
        server, count = str(self.where), len(requests)
        begun = time.perf_counter()
        answer = self.connection.ask(
            _joined(requests) if self._batched else {"batch": list(requests)}, self.adapter.timeout_s
        )
        self._waits.append((time.perf_counter() - begun) * 1e3)
        if self._batched:
            answers = [
                {
                    key: value[k : k + 1]
                    for key, value in answer.items()
                    if isinstance(value, np.ndarray) and len(value) == count
                }
                for k in range(count)
            ]
        else:
            answers = answer.get("batch")
        if not isinstance(answers, list) or len(answers) != count or not all(isinstance(one, dict) for one in answers):
            raise PolicyServerError(
                f"Expected {count} answers to a batch from the policy server at {server}.", code="H3-REMOTE-036"
            )
        return [chunk_of(one, self.adapter, self.width, server, batched=self._batched) for one in answers]

    # --- beside the steps ---------------------------------------------------------------------------------------------
    def in_background(self) -> BackgroundPolicy:
        """Return the policy for callers that cannot wait for a server."""
        return BackgroundPolicy(self)

    def recorded_info(self) -> dict[str, Any]:
        """Return the recorded facts about the server: its identity and its response times."""
        metadata = {key: value for key, value in self.connection.metadata.items() if key != OWN}
        fits = len(_json(metadata)) <= MOST_METADATA
        return {
            "remote": [
                {
                    "policy": self.name,
                    "protocol": "gr00t" if self._batched else "openpi",
                    "adapter": msgspec.to_builtins(self.adapter),
                    "metadata": msgspec.json.decode(_json(metadata)) if fits else {"sha256": _digest(metadata)},
                    "calls": len(self._waits),
                    **({"wait_ms": _summary(self._waits)} if self._waits else {}),
                    **({"infer_ms": _summary(self._infers)} if self._infers else {}),
                }
            ]
        }


def _joined(requests: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return nested requests of one world each as a request of all, along the first axis of arrays and lists."""
    first = requests[0]
    joined: dict[str, Any] = {}
    for key, value in first.items():
        values = [request[key] for request in requests]
        if isinstance(value, dict):
            joined[key] = _joined(values)
        elif isinstance(value, np.ndarray):
            joined[key] = np.concatenate(values)
        elif isinstance(value, list):
            joined[key] = [one for each in values for one in each]
        else:
            joined[key] = values
    return joined


def _usual_skill(view: Any) -> str:
    """Return the skill of a robot of social navigation whose server does not state it."""
    met = getattr(view, "met", None)
    return "" if met is None else "follow" if met else "find"


def _name(metadata: dict[str, Any], adapter: Adapter, where: Address) -> str:
    said = own_facts(metadata).get("name") if isinstance(metadata.get(OWN), dict) else metadata.get("name")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", said)[:40].strip("_") if isinstance(said, str) else ""
    # the address is left out: it means nothing to others, and the same server may move
    digest = _digest([metadata, msgspec.to_builtins(adapter)])
    return f"{'zmq' if where.scheme == 'zmq' else 'ws'}:{name or adapter.name}@{digest[:12]}"


def _json(value: Any) -> bytes:
    """Return a value as JSON; what JSON cannot hold is described in words."""
    return msgspec.json.encode(_plain(value), order="sorted")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {(key if isinstance(key, str) else repr(key)): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else repr(value)


def _digest(value: Any) -> str:
    return hashlib.sha256(_json(value)).hexdigest()


def _summary(values: Sequence[float]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 3), "p95": round(float(np.percentile(values, 95)), 3)}
