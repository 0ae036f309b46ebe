"""Live play of tasks in words, with instructions, choices, commands and messages of players."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from h3data.errors import InputError, suggest
from h3data.geometry import transform_points
from h3data.policies import Action
from h3data.scene.articulation import joints_of
from h3data_language.episode import STATES
from h3data_language.experts import HANDLING_WAIT
from h3data_language.grounding import FLOOR, home_of, spoken
from h3data_language.talk import Intent, say
from h3data_language.task import why_not
from h3data_play.app import Goal, Hud, Phrase, Spot, sentence_of
from h3data_play.apps.rearrange import RearrangeApp
from h3data_play.drivers import Driver, PersonDriver, RobotDriver, SkillDriver
from h3data_play.messages import Act, Bring, Use
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.skills import INSIDE, Destination, sentence
from sim_kinematic.tasks.task import Task

USES = {("clean", True): "clean", ("filled", True): "fill", ("filled", False): "pour", ("powered", True): "on"}
"""Words on the page for what a player can do to a thing, by the state and its value afterwards."""
DONE = {
    "clean": "The {} is clean now.",
    "fill": "The {} is full now.",
    "pour": "The {} is empty now.",
    "on": "The {} is switched on now.",
}
"""Texts for the player after something has been done to a thing."""
SAID = {
    "i_take": "I take the {}.",
    "i_leave": "I leave the {} to you.",
    "handled": "I have done what the {} needed.",
    "brought": "I have brought the {} to its place.",
    "is_in": "The {} is on the {} ({}).",
    "please_move": "Please move aside.",
}
"""Sentences for messages with a structured meaning for planners."""
PROGRESS = "{} of {} parts of the task are done."


class LanguageDriver(SkillDriver):
    """Agent of a task in words that can bring things to named places, and, if a person, also handle them."""

    def follow(self, message: Act) -> str:
        """Carry out a message of a player; commands of tasks in words become skills."""
        if isinstance(message, Use):
            return self.use(message)
        if isinstance(message, Bring):
            k, to = self.objects.held(self.number), Destination(message.place, message.next_to)
            if message.next_to and message.next_to not in self.objects.names:
                raise InputError(
                    f"There is no thing {message.next_to[:50]!r} here.{suggest(message.next_to[:50], self.objects.names)}",
                    code="H3-LANGUAGE-035",
                )
            return sentence("not_held") if k < 0 else self.bring(k, to)
        return super().follow(message)

    def use(self, message: Use) -> str:
        """Clean, fill, pour out or switch a thing."""
        if message.o >= len(self.objects.names):
            raise InputError(f"There is no object {message.o} in this task.", code="H3-LANGUAGE-036")
        play, k = self.session.play, message.o
        walks = message.lead and self.objects.held_by[k] != self.number
        if walks and (why := self.barred(k, lead=True)):
            return why
        why = why_not(play, self.number, k)
        if why and not (walks and why == sentence("too_far")):
            return why
        handle = Action("wait", k, HANDLING_WAIT)
        return self.do([Action("nav_to_object", k), handle] if walks and why else [handle])

    def bring(self, k: int, to: Destination) -> str:
        """Bring held thing ``k`` to a free spot at a destination; the goals of the task stay as they are."""
        team: Any = self.session.play.team
        found = team.spot_for(k, to)
        if isinstance(found, str):
            return sentence(found)
        point, owner = found[0], found[1].partition("|")[0]
        joint = joints_of(self.session.episode.scene).owner.get(owner, -1)
        if joint >= 0:  # a drawer is where it has been pulled out to
            openables = team.openables
            point = transform_points(openables.joints.motions(openables.positions)[joint], point[None])[0]
        return self.put_at(np.asarray(point, np.float64), lead=True)


class LanguagePerson(LanguageDriver, PersonDriver):
    """Person of a task in words."""


class LanguageRobot(LanguageDriver, RobotDriver):
    """Robot of a task in words, which puts things down only at goals and therefore assigns a new goal first."""

    def bring(self, k: int, to: Destination) -> str:
        """Give held thing ``k`` a goal at a destination and bring it there."""
        found = self.session.play.team.spot_for(k, to)  # type: ignore[attr-defined]
        if isinstance(found, str):
            return sentence(found)
        return self.do([Action("wait", k, 0, to), Action("nav_to_goal", k), Action("place", k)])


class LanguageApp(RearrangeApp):
    """App in which players read an instruction, carry it out with the other agents, and send them messages."""

    task: ClassVar[str | type[Task]] = "language"
    rules: ClassVar[Mapping[str, Any]] = {"max_steps": 9000, "end_on_collision": False, "solid_agents": True}
    partner: ClassVar[str | None] = "language_greedy"
    question: ClassVar[str] = "Did you complete the task?"
    shows_progress: ClassVar[bool] = False
    """True if players are told how many propositions have been satisfied."""

    def driver(self, number: int) -> Driver:
        """Return the driver of a person or a robot of a task in words."""
        is_person = isinstance(self.session.play.team.actors[number], DrivenPerson)  # type: ignore[attr-defined]
        return (LanguagePerson if is_person else LanguageRobot)(self.session, number)

    def hud(self, number: int) -> Hud:
        """Return the instruction, the time left, the states of things, and the progress if the task shows it."""
        memory, extra = self.session.play.memory, self.session.episode.extra
        uses, lines = [], list[str]()
        for k, (state, value) in enumerate(extra["uses"]):
            use = USES.get((state, value), "")
            is_done = bool(use) and memory["states"][STATES.index(state)][k] == value
            uses.append("" if is_done else use)
            lines += [DONE[use].format(self._thing(k))] if is_done else []
        if self.shows_progress:
            count = len(memory["evaluation"].propositions)
            lines.append(PROGRESS.format(round(float(memory["complete"]) * count), count))
        person = number >= 0 and self.session.episode.roster[number].kind == "human"
        words = str(self.session.recorder.header.episode.info["instruction"])
        return Hud(task=sentence_of(words), left_s=self.left_s, lines=tuple(lines), uses=tuple(uses) if person else ())

    def goals(self) -> list[Goal]:
        """Return nothing, because the instruction states where things have to be put."""
        return []

    def phrases(self) -> list[Phrase]:
        """Return the messages on buttons, about things that are taken or brought, and a request to make room."""
        things = self.session.play.team.objects.names  # type: ignore[attr-defined]
        found = [
            Phrase(self.spoken(said.text), said.text)
            for kind in ("i_take", "i_leave", "brought")
            for name in things
            for said in [say(kind, name)]
        ]
        free = ("Yes.", "No.", "Thank you!", "What are you doing?", "I do not know where it is.")
        return [Phrase(text, text) for text in free] + [Phrase(SAID["please_move"], "please_move"), *found]

    def spots(self) -> list[Spot]:
        """Return all furniture on or in which things can be put, each room, and its floor, by room."""
        home = home_of(self.session.episode.scene, self.session.episode.spec.open_m)
        spots = [Spot(name, f"anywhere in {words}", spoken(name)) for words, name in home.rooms.items()]
        spots += [
            Spot(f"{FLOOR}{name}", f"on the floor of {words}", spoken(name)) for words, name in home.rooms.items()
        ]
        for kind, places in (("", home.places), (INSIDE, home.insides)):
            for place in places.values():
                for nth, name in enumerate(place.names):
                    number = f" ({nth + 1})" if len(place.names) > 1 else ""
                    spots.append(
                        Spot(f"{kind}{name}", f"{kind or 'on '}the {self.label(name)}{number}", spoken(place.room))
                    )
        return sorted(spots, key=lambda spot: spot.room)

    def spoken(self, text: str) -> str:
        """Return a sentence for a planner's message; texts of people and language models are not changed."""
        intent = Intent.of(text)
        if intent is None:
            return text
        place = home_of(self.session.episode.scene, self.session.episode.spec.open_m).place_of.get(
            intent.names[-1].partition("|")[0] if intent.names else ""
        )
        room = [spoken(place.room)] if place else ["?"]
        return SAID[intent.kind].format(*map(self.label, intent.names), *room)

    def _thing(self, k: int) -> str:
        return self.label(self.session.play.team.objects.names[k])  # type: ignore[attr-defined]


class LanguageProgressApp(LanguageApp):
    """App that also shows how many parts of the task are done."""

    shows_progress: ClassVar[bool] = True
