"""Applications for live play: a task with its rules, words and markers.

A custom app is a subclass of `App`, given as ``module:Class``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from h3data.errors import InputError
from h3data.plugins import Registry
from h3data_play.drivers import Driver, PersonDriver, RobotDriver, SittingDriver
from h3data_play.messages import Act
from sim_kinematic.tasks.rearrange.codec import spoken
from sim_kinematic.tasks.sessions import Session, StepResult
from sim_kinematic.tasks.task import Task

_LEAF = "leaf"
"""Part name of a door between rooms, in homes of the generator."""


@dataclass(frozen=True, kw_only=True)
class Hud:
    """Text that the page shows to a player during a game."""

    task: str
    """Instruction for the player, as a sentence."""
    left_s: float | None = None
    """Remaining time [s]; None: no limit is shown."""
    lines: tuple[str, ...] = ()
    """Lines about the state of the game."""
    how: Mapping[str, str] = field(default_factory=dict)
    """Instructions by the player's device (``keys``, ``mouse``, ``touch``, ``pad``, ``headset``), instead of the page's
    own hints. For devices without an entry, the page lists the possible actions."""
    marker: tuple[float, float, float] | None = None
    """Point of the floor in the world [m] that the page marks with a ring, a label and a sign on the map."""
    uses: tuple[str, ...] = ()
    """Action that the player can apply to each object (``clean``, ``fill``, ``pour``, ``on`` or ``off``); empty for
    objects without one."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Goal of an object; the goal at index k belongs to the object at index k."""

    position: tuple[float, float, float]
    """Goal position of the object's origin in the world [m]."""
    label: str
    """Name of the goal's place, as players read it."""


class Phrase(NamedTuple):
    """Predefined message that a player sends by pressing a button."""

    label: str
    """Label of the button on the page."""
    text: str
    """Text of the message."""


class Spot(NamedTuple):
    """A place that a player can choose from a list."""

    name: str
    """Name of the place in the message ``bring``."""
    label: str
    room: str
    """Name of the room under which the place is listed."""


class App:
    """Application with which people play an episode of a task.

    The defaults suit any task, and a subclass overrides what differs. An instance serves one episode. `reset` is called
    first. In each step, `on_input` is then called with each message of a player, `step` with the result of the step,
    and `hud` for the text of each player.
    """

    task: ClassVar[str | type[Task]] = ""
    """Task of the app: its class, its name, or ``module:Class``."""
    rules: ClassVar[Mapping[str, Any]] = {}
    """Rules of the task that have other values than in simulations without players."""
    seats: ClassVar[tuple[str, ...]] = ("person",)
    """Roles that people play, unless the command line names others."""
    partner: ClassVar[str | None] = None
    """Policy of the agents without a player, unless the command line names one. None selects the task's default, and
    ``solo`` adds no such agents."""

    names: bool = False
    """True if a name stands over the head of every other agent."""
    question: ClassVar[str] = ""
    """Question to players at the end of an episode, answered by yes, no or unsure. If it is empty, no question is
    asked, and players can neither skip an episode nor report a problem."""

    session: Session
    ended: str = ""
    """Reason why the episode has ended: by its rules, by a player or by the app; empty while it is running."""

    def reset(self, session: Session) -> None:
        """Prepare the app for a new episode."""
        self.session = session

    def driver(self, number: int) -> Driver:
        """Return the driver with which a player moves agent ``number``, which has skills if the task has them."""
        is_person = self.session.episode.roster[number].kind == "human"
        if not self.session.task.control.has_skills:
            return (SittingDriver if is_person else Driver)(self.session, number)
        return (PersonDriver if is_person else RobotDriver)(self.session, number)

    def refusal(self, number: int, message: Act) -> str:
        """Return the reason why a message of the player of agent ``number`` is not carried out now; empty if it is.

        The reason is a sentence.

        The result may depend only on messages and the world, so that a game can continue after a crash.
        """
        return ""

    def on_input(self, number: int, message: Act) -> None:
        """Handle an accepted message from the player of agent ``number``."""

    def step(self, result: StepResult) -> str:
        """Handle the end of a step; return a reason to end the episode, or an empty text to continue."""
        return ""

    def hud(self, number: int) -> Hud:
        """Return the text for the player of agent ``number``, or for spectators (-1)."""
        info = self.session.recorder.header.episode.info
        return Hud(task=sentence_of(str(info["instruction"])), left_s=self.left_s)

    def goals(self) -> list[Goal]:
        """Return the goals of objects that the page marks in the home, if the task has such goals."""
        targets = getattr(self.session.episode, "targets", ())
        return [Goal(position=tuple(t.goal.tolist()), label=spoken(t.destination) or "its goal") for t in targets]

    def phrases(self) -> list[Phrase]:
        """Return the messages that players send by one press of a button.

        If there are any, the page also has a box for free text.
        """
        return []

    def spots(self) -> list[Spot]:
        """Return the named places to which players can bring the object in hand."""
        return []

    def spoken(self, text: str) -> str:
        """Return the text in which players read a message from another agent."""
        return text

    def label(self, name: str) -> str:
        """Return the word by which players read an object's name."""
        return name.rpartition("/")[2].replace("_", " ")

    def joint_label(self, name: str) -> str:
        """Return the words that players read for a door or drawer with the name ``thing/part``."""
        thing, _, part = name.rpartition("/")
        words = self.label(thing) if part == _LEAF else f"{self.label(thing)} {self.label(part)}"
        return " ".join(dict.fromkeys(words.split()))

    def over(self, number: int) -> str:
        """Return the text that the player of agent ``number`` reads at the end of the episode."""
        ended = self.session.ended or self.ended
        return {
            "success": "Done. Thank you!",
            "max_steps": "The time is up.",
            "finished": "Thank you!",
            "skipped": "The task has been skipped.",
            "closed": "The episode has been ended.",
        }.get(ended, f"The episode has ended: {ended.replace('_', ' ')}.")

    @property
    def left_s(self) -> float:
        """Time until the task's limit of steps, in whole seconds [s]."""
        spec, steps = self.session.episode.spec, len(self.session.recorder)
        return float((spec.max_steps - steps + 29) // 30)


def sentence_of(words: str) -> str:
    """Return an instruction with a capital letter and a full stop."""
    return words[:1].upper() + words[1:] + ("" if words.endswith(".") else ".")


def _require_app(found: Any) -> None:
    if not isinstance(found, type) or not (issubclass(found, Task) or (issubclass(found, App) and found.task)):
        raise InputError(
            "Expected a subclass of h3data_play.app.App that names its task, or of h3data.tasks.Task.",
            code="H3-PLAY-001",
        )


_APPS: Registry[Any] = Registry("h3data.apps", {}, what="app", check=_require_app)


def find_app(name: str) -> type[App]:
    """Return the app class for a name, for ``module:Class``, or for a task class.

    Raises:
        InputError: there is no such app.
    """
    found = _APPS.get(name)
    return type(found.__name__, (App,), {"task": found}) if issubclass(found, Task) else found
