"""Lookup of policies by name.

A name is looked up in the task, in the policies of every task (`COMMON`), and in installed packages (entry point group
``h3data.policies``). It may also be ``module:name``, a file of weights (``weights:FILE``) or the address of a policy server
(``ws://host:port``), whose scheme is an entry point of the group ``h3data.policy_servers``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

from h3data.errors import InputError, UntrustedNameError, suggest
from h3data.plugins import Registry, come_from_data
from h3data.recording.records import agent_numbers
from sim_kinematic.crowd.crowd import VERSION, CrowdModel
from sim_kinematic.crowd.errands import HandWork
from sim_kinematic.crowd.roles import check_groups, read_role, routines
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.policies.learned import PREFIX, naming, network_of, stamped, weights_hint
from sim_kinematic.policies.policy import External, FunctionPolicy, Policy, Still
from sim_kinematic.policies.waypoints import WanderPolicy, WaypointPolicy

Task = Any
"""Type of tasks, `sim_kinematic.tasks.task.Task`, which is in a layer above."""
Episode = Any
"""Type of episodes, `sim_kinematic.tasks.episode.Episode`, which is in a layer above."""


def _waypoints(task: Task, episode: Episode, number: int) -> Policy:
    # by their number among people: the first one walks the same way, whoever else is there
    nth = number - len(agent_numbers(episode.roster, "robot"))
    if nth > 0:
        return WaypointPolicy(episode.free, episode_seed(episode.seed, nth), episode.spec.human)
    # an episode of a file may say where the first one goes
    return WaypointPolicy(episode.free, episode.seed, episode.spec.human, episode.extra.get("human_goals", ()))


def _wander(task: Task, episode: Episode, number: int) -> Policy:
    return WanderPolicy(episode.free, episode_seed(episode.seed, number), episode.spec.human)


def _crowd(model: CrowdModel, task: Task, episode: Episode, number: int, words: str = "") -> Policy:
    role = read_role(words, episode.seed, number)
    named = ("stops", role.routine) if ":" in role.routine else (role.routine,)
    routine = routines().get(named[0])(episode, number, *named[1:]) if role.routine else None
    return CrowdPolicy(model, episode.free, episode.seed, number, episode.spec.human, role, routine)


COMMON: Mapping[str, Mapping[str, Callable[[Task, Episode, int], Policy]]] = {
    "robot": {"wander": _wander, "still": lambda *_: Still()},
    "human": {
        "waypoints": _waypoints,
        "wander": _wander,
        "orca": partial(_crowd, "orca"),
        "social_force": partial(_crowd, "social_force"),
        "still": lambda *_: Still(),
    },
}
"""Factories of policies of tasks whose agents drive and walk, by kind and name."""
SOLO = "solo"
"""Name of the policy of robots in recordings without robots."""


class AssignedPolicy(NamedTuple):
    """Policy of one agent."""

    policy: Any
    name: str
    """Name of the policy, as recorded."""
    kind: str
    """Kind of agent: ``robot`` or ``human``."""
    plan: str = ""
    """Plan that a planner follows in this episode; empty for other policies."""
    hands: HandWork | None = None
    """Work of the hands of a person who is driven from outside; None: see `works`."""
    version: int = VERSION
    """Version of the rules (`sim_kinematic.crowd.crowd.VERSION`) of the chores of a person who is driven from outside."""

    @property
    def is_external(self) -> bool:
        """Return whether the agent is controlled from outside."""
        return isinstance(self.policy, External)

    @property
    def takes_commands(self) -> bool:
        """Return whether the agent follows commands from outside, live or from a recording that is simulated again."""
        return bool(getattr(self.policy, "takes_commands", False))

    @property
    def takes_agent_view(self) -> bool:
        """Return whether the policy observes an `AgentView` in every task, even if others have a view of their own."""
        return bool(getattr(self.policy, "takes_agent_view", False))


def works(policy: AssignedPolicy) -> HandWork | None:
    """Return the state of the hands of an agent; None if they handle nothing."""
    return policy.hands or getattr(policy.policy, "hands", None)


def is_address(name: str) -> bool:
    """Return whether the name of a policy is the address of a policy server."""
    # a scheme as in RFC 3986, section 3.1, in lower case; weights:FILE lacks the two slashes
    return re.fullmatch(r"[a-z][a-z0-9+.-]*:(https?:)?//.*", name, re.DOTALL) is not None


PolicyChoice = str | Policy | External | AssignedPolicy | Callable[..., Any]
"""Choice of a policy: its name, ``weights:FILE``, ``module:name`` or ``ws://host:port``; a policy object; a function
``(view, base)``; or `External` for an agent that is controlled from outside."""
Assigned = Mapping[str, Any]
"""Policies by agent or kind, each a `PolicyChoice` or a sequence with one choice for each agent of a kind."""
KINDS = {"robot": "robot", "human": "human", "person": "human"}
ENTRIES = {"robot": "policy", "human": "partner"}
"""Option of a command, and entry of a recording's info, that names the policies of a kind of agent."""


@cache
def policy_servers() -> Registry[Any]:
    """Return the registered finders of policies behind addresses, by scheme.

    A finder is a function ``(address, task, kind, spec)`` that returns a `PolicyMaker`.
    """
    return Registry("h3data.policy_servers", {}, what="scheme of a policy's address")


@cache
def plugin_policies() -> Registry[Any]:
    """Return the registry of policies of installed packages, which also finds ``module:name``."""
    return Registry("h3data.policies", {}, what="policy")


def assign(task: Task, episode: Episode, chosen: Assigned | None = None) -> list[AssignedPolicy]:
    """Assign a policy to each agent of an episode.

    ``chosen`` has policies or their names by agent (``robot``, ``human_2``, ``person``) or by kind; other agents get
    the task's defaults.

    Raises:
        InputError: There is no such policy, or no such agent.
    """
    members, chosen = episode.roster, dict(chosen or {})
    if task.usage.can_be_solo and chosen.get("robot") == SOLO:
        del chosen["robot"]  # the episode has no robot
    names = [member.name for member in members]
    # ``person_2`` stands for ``human_2``
    aliases = {name.replace("human", "person", 1): name for name in names if name.startswith("human")}
    strangers = [key for key in chosen if key not in names and key not in KINDS and key not in aliases]
    if strangers:
        raise InputError(
            f"Nobody is called {strangers[0]!r}.{suggest(strangers[0], names, lead='Expected some of')}",
            code="H3-POLICY-003",
        )
    # a key that is the name of exactly one agent means this agent; any other key means a kind or an alias
    picked: list[Any] = [None] * len(members)
    for key, choice in chosen.items():
        kind = KINDS.get(key) if key not in names or names.count(key) != 1 else None
        if kind is None:
            picked[names.index(aliases.get(key, key))] = choice
            continue
        numbers = [k for k, member in enumerate(members) if member.kind == kind]
        for number, one in zip(numbers, each_of(choice, len(numbers), kind), strict=True):
            picked[number] = one
    made = [
        make_policy(task, episode, k, task.defaults[member.kind] if choice is None else choice)
        for k, (member, choice) in enumerate(zip(members, picked, strict=True))
    ]
    # only all policies together show whether everybody of a group has company
    check_groups(one.policy.member.role.group for one in made if isinstance(one.policy, CrowdPolicy))
    return made


def each_of(choice: Any, count: int, kind: str) -> list[Any]:
    """Return one choice for each of ``count`` agents, from one name for all or from one choice for each.

    Raises:
        InputError: The number of choices is neither one nor ``count``.
    """
    listed = (
        choice.split(",") if isinstance(choice, str) else list(choice) if isinstance(choice, list | tuple) else [choice]
    )
    # a policy object may hold the memory of one agent, so only names and outsiders are shared by several
    if len(listed) == 1 and (isinstance(listed[0], str) or count == 1 or isinstance(listed[0], External)):
        listed *= max(count, 1)
    if count and len(listed) != count:
        raise InputError(
            f"Expected one {ENTRIES[kind]} for each {kind}, {count} in all, or one name for all; got {len(listed)}.",
            code="H3-POLICY-004",
        )
    return listed[:count]


PolicyMaker = Callable[[Episode, int], AssignedPolicy]
"""Function that makes a new policy for the agent with a given number in one episode."""


def make_policy(task: Task, episode: Episode, number: int, choice: PolicyChoice) -> AssignedPolicy:
    """Return a new policy for one agent in one episode.

    Raises:
        InputError: there is no such policy; the message lists those that exist.
    """
    return resolve_policy(task, episode.roster[number].kind, choice)(episode, number)


def resolve_policy(task: Task, kind: str, choice: PolicyChoice, spec: Any = None) -> PolicyMaker:
    """Return a function that makes the chosen policy for an episode.

    Commands, environments, sessions, live play and plug-ins all look policies up here.

    Args:
        task: Task that is played; its `Task.named_policy` is asked first, then its tables, those of every task and plug-ins.
        kind: ``robot`` or ``human``.
        choice: A name, ``weights:FILE``, ``module:name`` or the address of a policy server; a policy, its class, a function
            ``(view, base)``, or `External`.
        spec: Rules that files of weights must fit; None if they follow from the episodes.

    Raises:
        InputError: there is no such policy; the message lists those that exist.
    """
    if isinstance(choice, str):
        return _named(task, kind, choice.strip(), spec)
    if isinstance(choice, AssignedPolicy):
        return lambda episode, number: choice
    if isinstance(choice, External):
        return lambda episode, number: AssignedPolicy(choice, "external", kind)
    # a class has the method of its objects too, so classes come before anything with ``act``
    if isinstance(choice, type):
        return lambda episode, number: AssignedPolicy(choice(), choice.__name__, kind)
    if hasattr(choice, "act"):
        return lambda episode, number: AssignedPolicy(choice, type(choice).__name__, kind)
    if callable(choice):
        name = getattr(choice, "__name__", type(choice).__name__)
        return lambda episode, number: AssignedPolicy(FunctionPolicy(choice, episode.bases[number]), name, kind)
    raise InputError(
        f"Expected a policy by name, with a method act, or a function, got {choice!r}.", code="H3-POLICY-001"
    )


def learned_policy(kind: str, name: str, spec: Any, task: str, play: Callable[..., Any]) -> PolicyMaker:
    """Return the maker of a policy of velocities with the weights that a name refers to (`is_learned`).

    Args:
        kind: ``robot`` or ``human``.
        name: ``weights:FILE`` or the name of a shipped policy.
        spec: Rules of `resolve_policy`; unless None, the weights are checked now and not at the first episode.
        task: Name of the task.
        play: Function ``(network, task, robot="")`` that returns a new policy for one episode and refuses weights for
            another task or robot.

    Raises:
        InputError: There are no such weights.
        FormatError: The weights are for another task or another robot.
    """
    network = network_of(name)
    if spec is not None:
        with naming(name):
            play(network, task)

    def learned(episode: Episode, number: int) -> AssignedPolicy:
        with naming(name):
            choose = play(network, task, robot=episode.roster[number].model)
        return AssignedPolicy(FunctionPolicy(choose, episode.bases[number]), stamped(name), kind)

    return learned


def _named(task: Task, kind: str, name: str, spec: Any) -> PolicyMaker:
    """Return the maker of a policy that is given by its name, as `resolve_policy` describes."""
    if is_address(name):
        # a recording or a list of episodes must not make this machine connect to an address of its choice
        if come_from_data():
            raise UntrustedNameError(
                "A file names the address of a policy server; only the user may. Hint: name it as the policy (ws://host:port).",
                code="H3-POLICY-065",
            )
        return policy_servers().get(name.partition(":")[0])(name, task, kind, spec)
    # recordings name a policy server by its own name and a digest of its description
    found = re.fullmatch(r"(?P<scheme>[a-z]+):(?P<name>[^:,]+)@(?P<digest>[0-9a-f]{12})", name)
    if found and found["scheme"] in policy_servers().names():
        raise InputError(
            f"The policy was that of the server {found['name']!r} ({found['digest']}), whose address is not recorded. "
            "Hint: start it, and name its address as the policy.",
            code="H3-POLICY-064",
        )
    # the task comes first: its files of weights and planners are none of the common policies
    made = task.named_policy(kind, name, spec)
    if made is not None:
        return made
    # a task's own policies replace common ones of the same name; common ones choose no skills
    own = (
        {**COMMON[kind], **task.policies.get(kind, {})} if not task.control.has_skills else task.policies.get(kind, {})
    )
    plugins = plugin_policies()
    model, plus, words = name.partition("+")
    if name in own:
        found = own[name]
    # only people of crowds have a role, which the words after the plus describe
    elif plus and model in own and getattr(own[model], "func", None) is _crowd:
        read_role(words)
        found = partial(own[model], words=words)
    # weights:FILE has a colon too, and is no module
    elif not name.startswith(PREFIX) and (":" in name or name in plugins.names()):
        found = plugins.get(name)
    else:
        raise unknown_policy(task, kind, name)
    return lambda episode, number: AssignedPolicy(as_policy(found, task, episode, number), name, kind)


def policy_names(task: Task, kind: str) -> list[str]:
    """Return the names of the policies that agents of a kind can have in a task, without those of plug-ins."""
    common = COMMON[kind] if not task.control.has_skills else {}
    return list(dict.fromkeys((*task.policies.get(kind, {}), *common)))


def unknown_policy(task: Task, kind: str, name: str) -> InputError:
    """Return the error for a policy name that is unknown for a kind of agent in a task, with the valid names."""
    there = [*policy_names(task, kind), *plugin_policies().names()]
    if name.startswith(PREFIX):  # tasks that take files of weights have read it by now
        return InputError(
            f"In {task.name} a {ENTRIES[kind]} cannot be a file of weights, got {name!r}. Expected one of: "
            f"{', '.join(there)} or module:name.",
            code="H3-POLICY-005",
        )
    return InputError(
        f"Unknown {ENTRIES[kind]} {name!r}."
        f"{suggest(name, there, more=', weights:FILE, module:name or ws://host:port')}{weights_hint(name)}",
        code="H3-POLICY-002",
    )


def as_policy(made: Any, task: Task, episode: Episode, number: int) -> Any:
    """Make a policy for an agent from an entry of a table or a plug-in.

    The entry is a factory ``(task, episode, number)``, a class of policies, a policy, or a function ``(view, base)``.
    """
    if isinstance(made, type):
        return made()
    if hasattr(made, "act"):
        return made
    # a function of two arguments is a policy itself; factories take three
    if getattr(made, "__code__", None) is not None and made.__code__.co_argcount == 2:
        return FunctionPolicy(made, episode.bases[number])
    return made(task, episode, number)
