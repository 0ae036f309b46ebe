"""Applications to play: a task with its rules, words and markers. Your own app is a subclass, given as ``module:Class``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from h3data.errors import InputError
from h3data.plugins import Registry
from h3data_play.drivers import Driver, PersonDriver, RobotDriver
from h3data_play.messages import Act
from sim_kinematic.tasks.rearrange.codec import spoken
from sim_kinematic.tasks.runner import Session, StepResult
from sim_kinematic.tasks.task import Task

_LEAF = "leaf"
"""The part of a door between rooms, in homes of the generator."""


@dataclass(frozen=True, kw_only=True)
class Hud:
    """Text that a player reads during a game."""

    task: str
    """Task of the player, as a sentence."""
    left_s: float | None = None
    """Remaining time [s]; None: no limit is shown."""
    lines: tuple[str, ...] = ()
    """Lines about the state of the game."""
    how: Mapping[str, str] = field(default_factory=dict)
    """Instructions by the player's device (``keys``, ``mouse``, ``touch``, ``pad``, ``headset``), instead of the page's
    own hints. For devices without an entry, the page lists the possible actions."""
    marker: tuple[float, float, float] | None = None
    """Point of the floor that the page marks with a ring, a label and a sign on the map [m]."""
    uses: tuple[str, ...] = ()
    """Actions of the player on each object in place (``clean``, ``fill``, ``pour``, ``on``, ``off``), or none."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Goal of an object; goal number k is that of object number k."""

    position: tuple[float, float, float]
    """Goal position of the object's origin [m]."""
    label: str
    """Name of the place."""


class Phrase(NamedTuple):
    """A message that a player sends by pressing a button."""

    label: str
    """Words of the button on the page."""
    text: str
    """Text of the message."""


class Spot(NamedTuple):
    """A place that a player can choose from a list."""

    name: str
    """Name of the place in a message ``bring``."""
    label: str
    room: str
    """Words for the room under which the place is listed."""


class App:
    """Application for people who play an episode of a task. The defaults suit any task; a subclass overrides what differs.

    An object of it lives for one episode. `reset`, then for each step `on_input` for what players have sent, `step` for what
    happened, `hud` for what each player reads.
    """

    task: ClassVar[str | type[Task]] = ""
    """Task: its class, its name, or ``module:Class``."""
    rules: ClassVar[Mapping[str, Any]] = {}
    """Rules of the task that differ where people play it."""
    seats: ClassVar[tuple[str, ...]] = ("person",)
    """Roles that are played unless the command line names others."""
    partner: ClassVar[str | None] = None
    """Policy of the agents that nobody plays, unless the command line names one; None: the task's default, ``solo``: there are
    none."""

    question: ClassVar[str] = ""
    """Question to players when an episode has ended, answered by yes, no or unsure; empty: none is asked, and players can
    neither skip an episode nor report a problem."""

    session: Session
    ended: str = ""
    """Reason why the episode has ended: by its rules, by a player or by the app; empty while it is running."""

    def reset(self, session: Session) -> None:
        """Begin an episode."""
        self.session = session

    def driver(self, number: int) -> Driver:
        """Return the driver with which a player moves agent ``number``: one with skills, if the task has them."""
        if not self.session.task.control.has_skills:
            return Driver(self.session, number)
        is_person = self.session.episode.roster[number].kind == "human"
        return (PersonDriver if is_person else RobotDriver)(self.session, number)

    def refusal(self, number: int, message: Act) -> str:
        """Return the reason why a message of the player of agent ``number`` is not carried out now; empty if it is.

        The reason is a sentence.

        Like everything in an app, it may depend only on messages and the world, so that a game can continue after a
        crash.
        """
        del number, message
        return ""

    def on_input(self, number: int, message: Act) -> None:
        """Handle a message of the player of agent ``number``, which has been accepted."""

    def step(self, result: StepResult) -> str:
        """Handle the end of a step; a text that is returned ends the episode for that reason."""
        del result
        return ""

    def hud(self, number: int) -> Hud:
        """Return the text for the player of agent ``number``, or for spectators (-1)."""
        del number
        info = self.session.recorder.header.episode.info
        return Hud(task=sentence_of(str(info["instruction"])), left_s=self.left_s)

    def goals(self) -> list[Goal]:
        """Return the markers in the home: the goals of things, in tasks that have such goals."""
        targets = getattr(self.session.episode, "targets", ())
        return [Goal(position=tuple(t.goal.tolist()), label=spoken(t.destination) or "its goal") for t in targets]

    def phrases(self) -> list[Phrase]:
        """Return the messages that are sent by one press. If there are any, the page has a box for others too."""
        return []

    def spots(self) -> list[Spot]:
        """Return the places to which players can bring what they hold, by name."""
        return []

    def spoken(self, text: str) -> str:
        """Return the words of a message of another agent, as players read them."""
        return text

    def label(self, name: str) -> str:
        """Return the word for an object of the recording."""
        return name.rpartition("/")[2].replace("_", " ")

    def joint_label(self, name: str) -> str:
        """Return the words for a door or drawer ``thing/part``."""
        thing, _, part = name.rpartition("/")
        words = self.label(thing) if part == _LEAF else f"{self.label(thing)} {self.label(part)}"
        return " ".join(dict.fromkeys(words.split()))

    def over(self, number: int) -> str:
        """Return the text for the player at the end."""
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
        """Time until the task's limit of steps [s], whole seconds."""
        spec, steps = self.session.episode.spec, len(self.session.recorder)
        return float((spec.max_steps - steps + 29) // 30)


def sentence_of(words: str) -> str:
    """Return an instruction as a sentence."""
    return words[:1].upper() + words[1:] + ("" if words.endswith(".") else ".")


def _require_app(found: Any) -> None:
    if not isinstance(found, type) or not (issubclass(found, Task) or (issubclass(found, App) and found.task)):
        raise InputError(
            "Expected a subclass of h3data_play.app.App that names its task, or of h3data.tasks.Task.",
            code="H3-PLAY-001",
        )


_APPS: Registry[Any] = Registry("h3data.apps", {}, what="app", check=_require_app)


def find_app(name: str) -> type[App]:
    """Return the app with a name, or ``module:Class``, where the class may also be that of a task.

    Raises:
        InputError: there is no such app.
    """
    found = _APPS.get(name)
    return type(found.__name__, (App,), {"task": found}) if issubclass(found, Task) else found
