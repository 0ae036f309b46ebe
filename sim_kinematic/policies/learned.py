"""Learned policies from files of weights, for both tasks (``--policy weights:FILE``; h3data docs learned-policies)."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import Array
from h3data.render.light.sources import LightMode
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies import network as files
from sim_kinematic.policies import visual_policy
from sim_kinematic.policies.choosers import chooser_network
from sim_kinematic.policies.choosers.chooser_network import SkillPolicyNetwork
from sim_kinematic.policies.network import Network
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import SocialNavView
from sim_kinematic.policies.visual_policy import VisualPolicy
from sim_kinematic.sensing.encodings import OF_COMMANDS
from sim_kinematic.sensing.sensor import first_point
from sim_kinematic.sensing.table import FOLLOWER, TABLE, Pose

PREFIX = "weights:"
SHIPPED_NAVIGATORS: Mapping[str, str] = {name: f"policies/{name}.npz" for name in ("end_to_end", "end_to_end_paper")}
"""Trained robots of social navigation that are included in the package (h3data docs training)."""
SHIPPED_HELPERS: Mapping[str, str] = {
    name: f"policies/{name}.npz" for name in ("learn_single", "plan_pop_3_robot", "plan_pop_3_pixels", "learn_pop")
}
"""Trained robots of rearrangement that are included in the package (h3data docs populations)."""
SHIPPED_PARTNERS: Mapping[str, str] = {
    f"{population}_partner_{k}": f"policies/{population}_partner_{k}.npz"
    for population in ("learn_single", "learn_pop")
    for k in range(3)
}
"""Trained people of rearrangement: of three runs of Learn-Single, and three of the eight of Learn-Pop."""
SHIPPED: Mapping[str, str] = {**SHIPPED_NAVIGATORS, **SHIPPED_HELPERS, **SHIPPED_PARTNERS}
"""Names of all included learned policies."""
_STAMP = re.compile(r"^(?P<file>.+)@(?P<digest>[0-9a-f]{12})$")
"""Name of a file of weights with the beginning of the digest of its contents."""

AnyNetwork = Network | VisualPolicy | SkillPolicyNetwork
Fitting = TypeVar("Fitting", bound=AnyNetwork)


# --- names --------------------------------------------------------------------------------------------------------------
def is_learned(policy: str) -> bool:
    """Return whether the name of a policy stands for a file of weights: ``weights:FILE``, or a name in `SHIPPED`."""
    return policy.startswith(PREFIX) or policy in SHIPPED


def weights_hint(name: str) -> str:
    """Return the name that was probably meant if a name is the path of a file; otherwise an empty text."""
    return f" Hint: {PREFIX}{name}" if Path(name).is_file() else ""


def stamped(policy: str) -> str:
    """Return the name of a policy as recordings store it, which identifies its exact weights.

    For a file of weights it is ``weights:FILE@digest``, with 12 digits of the file's digest. If the policy sees its
    colours in another light than in training, the light follows, as in ``weights:FILE@digest@baked``. Other names are
    unchanged.

    Raises:
        InputError: The file does not exist, is not a policy, or differs from the digest in the name.
    """
    if not policy.startswith(PREFIX):
        return policy
    name, light = _without_light(policy)
    network = network_of(name)
    stamp = name if _STAMP.match(name) else f"{name}@{network.digest[:12]}"
    # the light of training is not named, so one policy has one name
    return f"{stamp}@{light}" if light and network_light(network_of(policy)) != network_light(network) else stamp


def network_light(network: AnyNetwork) -> LightMode | None:
    """Return the light in the colours that a network observes; None if it observes no colours."""
    return network.card.light if isinstance(network, VisualPolicy) and network.sees_colours else None


def in_light(policy: str, light: LightMode | None) -> str:
    """Return the name of a policy that sees its colours in the given light.

    None means the light of its training. Policies without colours keep their names.
    """
    if light is None or not is_learned(policy) or network_light(network_of(policy)) is None:
        return policy
    return stamped(f"{_without_light(policy)[0]}@{light}") if policy.startswith(PREFIX) else policy


def _without_light(policy: str) -> tuple[str, LightMode | None]:
    """Return a name without the light at its end, and the light; None: the name ends with none."""
    found = re.match(r"^(?P<name>.+)@(?P<light>baked|flat)$", policy) if policy.startswith(PREFIX) else None
    return (found["name"], "baked" if found["light"] == "baked" else "flat") if found else (policy, None)


def network_of(policy: str) -> AnyNetwork:
    """Load the network that a name refers to: ``weights:FILE``, ``weights:FILE@digest``, or a name in `SHIPPED`.

    With ``@baked`` or ``@flat`` at the end, the network sees its colours in this light, regardless of the light in its
    training.

    Raises:
        InputError: The file does not exist, is not a policy, or differs from the digest in the name.
    """
    bare, light = _without_light(policy)
    name = str(builtin_path(SHIPPED[policy])) if policy in SHIPPED else bare.removeprefix(PREFIX)
    found = _STAMP.match(name)
    if not name:
        raise InputError("Expected the path of a file of weights, as weights:FILE.", code="H3-POLICY-013")
    path = Path(found["file"] if found else name)
    # 0 for a file that is not there: the reader has a message about it
    network = _loaded(path, path.stat().st_mtime_ns if path.is_file() else 0)
    if found and not network.digest.startswith(found["digest"]):
        raise InputError(
            f"The weights are no longer those that {policy} names: their digest is {network.digest[:12]}. "
            f"Hint: weights:{path} takes them as they are.",
            code="H3-POLICY-014",
        )
    if light is not None:
        if not isinstance(network, VisualPolicy):
            raise InputError(
                f"The network sees no colours, so light makes no difference to it. Policy: {policy}",
                code="H3-POLICY-019",
            )
        return network.in_light(light)
    return network


@lru_cache(maxsize=32)
def _loaded(path: Path, changed_ns: int) -> AnyNetwork:
    """Return the network in a file; it is read once for each time ``changed_ns`` at which the file was changed [ns]."""
    del changed_ns  # part of the cache's key, so that a changed file is read again
    found, data = files.read_arrays(path)
    if found == visual_policy.FILE_FORMAT:
        return visual_policy.policy_from(data, path, kind_of=_kind_of)
    if found == files.FILE_FORMAT:
        return files.network_from(data, path)
    raise FormatError(
        f"Expected a file of weights ({files.FILE_FORMAT}) or a trained policy ({visual_policy.FILE_FORMAT}), got {found}. "
        f"{files.HINT} File: {path}",
        code="H3-POLICY-063",
    )


def _kind_of(network: str) -> type[VisualPolicy] | type[SkillPolicyNetwork]:
    """Return the class of the network that a card names; PyTorch is imported for one that needs it."""
    if network == chooser_network.KIND:
        return SkillPolicyNetwork
    if network == "resnet18_lstm":
        from sim_kinematic.policies.networks.resnet_lstm import ResNetPolicy

        return ResNetPolicy
    return VisualPolicy


# --- social navigation --------------------------------------------------------------------------------------------------
class NavigationContext:
    """Observations of a robot of social navigation in a view, as a `sim_kinematic.sensing.table.Context` of one world."""

    xp = np

    def __init__(self, view: SocialNavView, spec: BaseSpec) -> None:
        self._view, self._spec = view, spec
        self.now = Pose(view.robot_xz, np.asarray(view.robot_heading))
        self.other = Pose(view.human_xz, None)

    @property
    def before(self) -> Pose:
        """State of the robot one step ago; at the start, its present state."""
        return self.now if self._view.robot_before is None else Pose(*self._view.robot_before)

    @property
    def other_before(self) -> Pose:
        """State of the person one step ago; at the start, their present state."""
        return self.other if self._view.human_before is None else Pose(self._view.human_before, None)

    def floor_y(self) -> Array:
        """Return the height of the floor where the robot is, [] [m]."""
        return np.asarray(self._view.free.height_at(self._view.robot_xz))

    def path(self) -> tuple[Array, Array]:
        """Return the shortest path to the person: its length [] [m] and its first waypoint [2] [m]."""
        # a waypoint underfoot would give a direction that changes with every step
        view, beyond_m = self._view, self._spec.disc_radius_m / 2
        point = first_point(view.free, view.robot_xz, view.human_xz, view.geodesic_m, beyond_m=beyond_m)
        return np.asarray(view.geodesic_m), point

    def clearance(self, points: Array) -> Array:
        """Return signed distance [n] [m] of points [n, 2] to the nearest obstacle."""
        return self._view.free.signed_distance(points)


def read_sensors(view: SocialNavView, spec: BaseSpec, names: Iterable[str]) -> dict[str, Array]:
    """Return the named observations at this moment, some of `FOLLOWER`, each float64 [n]."""
    moment = NavigationContext(view, spec)
    return {name: np.asarray(TABLE[name].of(moment), np.float64) for name in names}


def navigation_input(view: SocialNavView, spec: BaseSpec, names: tuple[str, ...]) -> NDArray[np.float32]:
    """Return the named observations at this moment, concatenated to one float32 vector [in]."""
    return np.concatenate(list(read_sensors(view, spec, names).values())).astype(np.float32)


class LearnedNavigation:
    """A robot of social navigation whose base velocity is the output [2] of a network, clipped to -1..1."""

    def __init__(self, network: Network) -> None:
        require(network, FOLLOWER, outputs=2)
        self.network = network

    def __call__(self, view: SocialNavView, spec: BaseSpec) -> Velocity:
        """Return the velocity of the base for a view of the robot."""
        out = self.network(self.look(view, spec))
        # a network that has diverged gives NaN, which no world takes
        forward, turn = np.clip(np.nan_to_num(out, nan=0.0), -1, 1).tolist()
        return Velocity(forward, turn, "follow" if view.met else "find")

    def look(self, view: SocialNavView, spec: BaseSpec) -> NDArray[np.float32]:
        """Return the current input of the network, [in]."""
        return navigation_input(view, spec, self.network.observations)


class VisualNavigation:
    """Learned policy of a robot in social navigation, with pictures and a recurrent memory.

    Each episode needs a policy of its own. An action is repeated for as many steps as in training.
    """

    def __init__(self, network: VisualPolicy, *, robot: str = "") -> None:
        """Check that the network fits the robot.

        Args:
            network: the policy.
            robot: name of the robot's body; empty if unknown.

        Raises:
            FormatError: The network does not fit, or is for another robot.
        """
        require(network, (*visual_policy.PICTURES, *OF_COMMANDS), outputs=2)
        if robot and robot != network.card.robot:
            raise FormatError(
                f"These weights drive the robot {network.card.robot}, the episode has {robot}.", code="H3-POLICY-020"
            )
        self.network = network
        self._state, self._action = network.start(), np.zeros(2, np.float32)
        self._step, self._decision = -1, -1

    def __call__(self, view: SocialNavView, spec: BaseSpec) -> Velocity:
        """Return the velocity of the base for a view of the robot; the network is evaluated once for several steps."""
        # a step that is not later begins another episode, or the same one anew, with an empty memory
        if view.step == 0 or view.step <= self._step:
            self._state, self._action, self._decision = self.network.start(), np.zeros(2, np.float32), -1
        decision = view.step // self.network.card.hold
        # also where it is first asked between two decisions: until the next one it would stand still
        if decision != self._decision:
            self._decision = decision
            out, self._state = self.network(self.look(view, spec), self._action, self._state)
            self._action = np.clip(np.nan_to_num(out, nan=0.0), -1, 1)
        self._step = view.step
        forward, turn = self._action.tolist()
        return Velocity(forward, turn, "follow" if view.met else "find")

    def look(self, view: SocialNavView, spec: BaseSpec) -> dict[str, NDArray[Any]]:
        """Return the current observations by name, as in training.

        Raises:
            InputError: The network observes pictures, and the view takes none.
        """
        card = self.network.card
        # the detector too, which is computed from a picture
        pictures = tuple(n for n in card.observations if n not in FOLLOWER)
        shown: dict[str, NDArray[Any]] = dict(read_sensors(view, spec, (n for n in card.observations if n in FOLLOWER)))
        if pictures and view.pictures is None:
            raise InputError(
                f"The policy needs {' and '.join(pictures)}, and nobody takes pictures here.", code="H3-POLICY-021"
            )
        return shown | (view.pictures(pictures, card.picture_size, card.light) if pictures and view.pictures else {})


@contextmanager
def naming(policy: str) -> Iterator[None]:
    """Add the name of the policy to a `FormatError` about a network that does not fit."""
    try:
        yield
    except FormatError as fault:
        raise FormatError(f"{fault} Policy: {policy}", code=fault.code) from None


def navigation_of(network: AnyNetwork, task: str, *, robot: str = "") -> LearnedNavigation | VisualNavigation:
    """Return a new policy that plays a network, for one episode of a task.

    Raises:
        FormatError: the network is for another task or another robot.
    """
    fitting = trained_for(network, task, Network, VisualPolicy)
    return VisualNavigation(fitting, robot=robot) if isinstance(fitting, VisualPolicy) else LearnedNavigation(fitting)


def trained_for(network: AnyNetwork, task: str, *kinds: type[Fitting]) -> Fitting:
    """Return a network after checking that it is for a task, and of one of some kinds.

    Raises:
        FormatError: The network is for another task, or is of another kind.
    """
    if network.task != task or not isinstance(network, kinds):
        raise FormatError(
            f"Expected weights for the task {task}, these are for {network.task!r}.", code="H3-POLICY-016"
        )
    return network


def require(network: Network | VisualPolicy, known: Collection[str], *, outputs: int) -> None:
    """Check that a network only needs known observations and has a given number of outputs.

    Raises:
        FormatError: The network does not fit.
    """
    strangers = [name for name in network.observations if name not in known]
    if strangers:
        raise FormatError(
            f"The network wants observations that a policy from a file is not given: {', '.join(strangers)}. There are: "
            f"{', '.join(known)}.",
            code="H3-POLICY-017",
        )
    if network.outputs != outputs:
        raise FormatError(
            f"Expected a network with {outputs} outputs, this one has {network.outputs}.", code="H3-POLICY-018"
        )
