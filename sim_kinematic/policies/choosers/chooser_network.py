"""Recurrent network that scores the choices of an agent of rearrangement, stored in a file of plain arrays.

``objects -> shared layer -> GRU(all objects, the rest) -> a score for each skill with each object, and for each choice
without an object``. All objects go through the same weights, with their number as one of the inputs. So a policy
generalizes from one object to another, and can still prefer one of them. `h3data_training.populations.networks`
implements the same network in PyTorch.

The file has the format of `sim_kinematic.policies.visual_policy`: arrays and a card. Nothing in it is executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from sim_kinematic.agents.skills import PRIMITIVES
from sim_kinematic.policies.visual_policy import (
    PICTURES,
    CardedNetwork,
    PolicyCard,
    VisualPolicy,
    array_faults,
    picture_features,
    picture_in,
    picture_of,
    picture_shapes,
    rows_in,
)
from sim_kinematic.sensing.encodings import DETECTOR, OF_CHOICES
from sim_kinematic.sensing.table import HUMANOID_GPS, SENSES

KIND = "gru_chooser"
SKILLS_WITH_OBJECT = 4
"""Skills with an object, the first of `sim_kinematic.agents.skills.choices`: ``nav_to_object``, ``nav_to_goal``,
``pick`` and ``place``."""
OBSERVATIONS = (
    "obj_gps_compass",
    "obj_goal_gps_compass",
    "way_to_objects",
    "way_to_goals",
    "other_way_to_objects",
    "other_way_to_goals",
    "other_approach",
    "path_ahead",
    "other_path_ahead",
    "holds",
    "held_by_other",
    "at_goal",
    "other_gps_compass",
    "other_velocity",
    "close",
    "elapsed_s",
    "last_done",
    "last_failed",
    "interrupted",
)
"""Observations of a chooser, in this order (`sim_kinematic.sensing.table.SENSES`)."""
OF_OTHER = tuple(name for name in OBSERVATIONS if SENSES[name].of_other)
"""Observations that contain the position of the other agent."""
PIXELS = (
    "arm_depth",
    DETECTOR,
    "obj_start_gps_compass",
    "obj_goal_gps_compass",
    "holds",
    HUMANOID_GPS,
    "other_from_starts",
    "other_from_goals",
    "egomotion",
    "last_done",
    "last_failed",
    "interrupted",
)
"""Observations of a chooser with a camera, in this order: those of the paper's robot (section 4.2; objects and goals as
in Habitat's configuration, at their initial places), and the result of its own last choice. The distance of the person
from each start and goal follows from the observations of the paper's robot. The chooser does not observe what the
person does or holds, where objects are now, which of them are at their goals, or any path."""
CHOOSING = ("last_done", "last_failed", "interrupted")
"""Observations that every chooser needs."""


def rest_count(agent: str) -> int:
    """Return the number of choices without an object: ``wait`` and a robot's primitives."""
    return 1 + (len(PRIMITIVES) if agent == "robot" else 0)


def numbers_of(observations: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of observations that are not pictures."""
    return tuple(name for name in observations if name not in PICTURES)


def input_lengths(agent: str, observations: tuple[str, ...] = OBSERVATIONS) -> tuple[int, int]:
    """Return the lengths of two inputs: of one object without its number, and of the rest without picture features."""
    observations = numbers_of(observations)
    encodings = [OF_CHOICES[name] for name in observations if name in OF_CHOICES]
    of_object = sum(e.length for e in encodings if e.times == "objects")
    rest = sum(e.length for e in encodings if e.times == "once")
    choosing = len(observations) - len(encodings)
    return of_object + choosing * SKILLS_WITH_OBJECT, rest + choosing * rest_count(agent)


def encoded(
    shown: Mapping[str, NDArray[Any]], *, agent: str, objects: int, observations: tuple[str, ...] = OBSERVATIONS
) -> tuple[Array, Array]:
    """Return the network's inputs from observations by name: those of each object [K, F] and the rest [R], float32.

    The last columns of both mark the choice that has been interrupted.

    Raises:
        InputError: an observation is missing or has another length.
    """
    each, rest = [], []
    for name in numbers_of(observations):
        encoding = OF_CHOICES.get(name)
        # observations without an encoding have a number for each choice, skill by skill as `choices` lists them
        own = SKILLS_WITH_OBJECT * objects
        length = (
            own + rest_count(agent)
            if encoding is None
            else encoding.given * (objects if encoding.times == "objects" else 1)
        )
        seen = np.asarray(shown.get(name, ()), np.float32)
        if seen.shape != (length,):
            raise InputError(
                f"Expected the observation {name} [{length}], got {list(seen.shape)}.", code="H3-POLICY-006"
            )
        if encoding is None:
            each.append(seen[:own].reshape(SKILLS_WITH_OBJECT, objects).T)
            rest.append(seen[own:])
        elif encoding.times == "objects":
            each.append(encoding.of(np, seen.reshape(objects, encoding.given)))
            if hides(name, observations):
                each[-1] = each[-1] * (1 - np.asarray(shown["held_by_other"], np.float32))[:, None]
        else:
            rest.append(encoding.of(np, seen[None])[0])
    # in the order of the names, the last of which is `interrupted`: scores find its columns at the end
    return np.concatenate(each, 1).astype(np.float32), np.concatenate(rest).astype(np.float32)


def hides(name: str, observations: tuple[str, ...]) -> bool:
    """Return whether the inputs of an observation are set to 0 for objects that the other agent holds."""
    # observations that tell where objects are. An object in the other agent's hand would tell where that agent
    # is, so a chooser without the GPS gets zeros for it.
    places = ("obj_gps_compass", "way_to_objects", "path_ahead")
    return name in places and "other_gps_compass" not in observations


@dataclass(frozen=True, kw_only=True, eq=False)
class SkillPolicyNetwork(CardedNetwork):
    """Network that scores the choices of an agent of rearrangement.

    Its arrays are weight and bias of ``object``, ``each_0``, ``each_1`` [4, n], ``rest_0`` and ``rest_1``, those of
    ``gru`` [3 H, ...], and ``persist`` [1], which is added to the score of the choice that was interrupted. A network
    with a camera also has the arrays of `sim_kinematic.policies.visual_policy.picture_shapes`.
    """

    kind: ClassVar[str] = KIND

    def __post_init__(self) -> None:
        faults = _faults(self.card, self.arrays)
        if faults:
            raise InputError(f"These arrays make no policy: {'; '.join(faults)}.", code="H3-POLICY-007")

    @property
    def outputs(self) -> int:
        """Number of choices of the network."""
        return SKILLS_WITH_OBJECT * self.card.objects + rest_count(self.card.agent)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that determines the network's behaviour."""
        card = self.card
        about: tuple[Any, ...] = (card.task, card.network, card.agent, card.objects, card.observations, card.hold)
        if self.sees:
            about = (*about, card.picture_size)
        # digests of files from before cards had these entries stay
        about += () if card.temperature == 1.0 else (card.temperature,)
        return self._digest(about if card.primitives else (*about, "without primitives"))

    @cached_property
    def offered(self) -> NDArray[np.bool_]:
        """Return which choices are available to the policy in general, [C]."""
        found = np.ones(self.outputs, np.bool_)
        if not self.card.primitives:
            found[SKILLS_WITH_OBJECT * self.card.objects + 1 :] = False  # after ``wait``
        return found

    def __call__(
        self, each: Array, rest: Array, state: Array, shown: Mapping[str, NDArray[Any]] | None = None
    ) -> tuple[Array, Array]:
        """Return the scores of all choices and the next state [H], given inputs from `encoded` and the state [H].

        Raises:
            InputError: the picture that the network needs is missing in ``shown``, or has another size.
        """
        count = len(each)
        if self.sees:
            rest = np.concatenate([picture_features(picture_of(self.card, shown or {}), self._layer), rest])
        # one-hot numbers of the objects: with equal weights for all, a policy could not keep to one of two alike
        things = np.maximum(self._layer("object", np.concatenate([each, np.eye(count, dtype=np.float32)], 1)), 0)
        state = self._remember(np.concatenate([rest, things.ravel()]), state)
        known = np.concatenate([np.broadcast_to(state, (count, len(state))), things], 1)
        of_objects = self._layer("each_1", np.maximum(self._layer("each_0", known), 0))
        others = self._layer("rest_1", np.maximum(self._layer("rest_0", np.concatenate([state, rest])), 0))
        # scores are by skill first and object second, as `choices` lists them; the transposes bring them there
        interrupted = np.concatenate([each[:, -SKILLS_WITH_OBJECT:].T.ravel(), rest[-len(others) :]])
        scores = np.concatenate([of_objects.T.ravel(), others]) + self.arrays["persist"][0] * interrupted
        return scores.astype(np.float32), state


def shapes(card: PolicyCard, arrays: Mapping[str, Array]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all arrays by name; widths are those of the given arrays."""
    of_object, rest = input_lengths(card.agent, card.observations)
    found, features = picture_shapes(card, arrays)
    rest += features
    wide, hidden = rows_in(arrays, "object.weight"), rows_in(arrays, "gru.weight_ih") // 3
    each, other = rows_in(arrays, "each_0.weight"), rows_in(arrays, "rest_0.weight")
    layers = {
        "object": (wide, of_object + card.objects),
        "each_0": (each, hidden + wide),
        "each_1": (SKILLS_WITH_OBJECT, each),
        "rest_0": (other, hidden + rest),
        "rest_1": (rest_count(card.agent), other),
    }
    found |= {f"{name}.weight": shape for name, shape in layers.items()}
    found |= {f"{name}.bias": shape[:1] for name, shape in layers.items()}
    return found | {
        "gru.weight_ih": (3 * hidden, rest + card.objects * wide),
        "gru.weight_hh": (3 * hidden, hidden),
        "gru.bias_ih": (3 * hidden,),
        "gru.bias_hh": (3 * hidden,),
        "persist": (1,),
    }


def _faults(card: PolicyCard, arrays: Mapping[str, Array]) -> list[str]:
    """Return everything in a card and arrays that does not fit together, in words."""
    if card.network != KIND:
        return [f"unknown network {card.network!r}, expected {KIND}"]
    if card.agent not in ("robot", "human"):
        return [f"it is for the agent {card.agent!r}, expected robot or human"]
    # observations without which no chooser works that has no camera
    always_needed = ("held_by_other", *CHOOSING)
    all_names, needed = (PIXELS, CHOOSING) if picture_in(card.observations) else (OBSERVATIONS, always_needed)
    known = tuple(name for name in all_names if name in card.observations or name in needed)
    # the order counts, as it is that of the columns of the weights
    if card.observations != known:
        return [
            f"it is shown {', '.join(card.observations) or 'nothing'}, expected some of {', '.join(all_names)}, in this "
            f"order, and {', '.join(needed)} among them"
        ]
    if picture_in(known):
        fault = "a width and a height" if card.picture_size is None else VisualPolicy.size_fault(card.picture_size)
        if fault:
            return [f"its pictures are {card.picture_size} pixels, expected {fault}"]
    if not 1 <= card.objects <= 16:
        return [f"it knows {card.objects} objects, expected 1 to 16"]
    if not 1 <= card.hold <= 3000:
        return [f"it thinks again after {card.hold} steps, expected 1 to 3000"]
    if not 0.01 <= card.temperature <= 100:
        return [f"its temperature is {card.temperature}, expected 0.01 to 100"]
    return array_faults(arrays, shapes(card, arrays))
