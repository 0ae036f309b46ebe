"""Text descriptions of the home and its current state for a language model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from h3data.policies import RearrangeView
from h3data.recording import Event
from h3data.scene.articulation import joint_names
from h3data_language.evaluation.layout import Layout, Surface
from h3data_language.grounding import FLOOR, Home, home_of, room_words, spoken
from h3data_llm.tools import Names
from sim_kinematic.agents.skills import INSIDE
from sim_kinematic.motion.state import NOBODY

MESSAGES = 8
"""Number of the latest messages in a request to a language model."""
OVER_M = 0.05
"""Largest distance below a surface of the origin of a thing that lies on it [m]."""


class WorldText:
    """Names in the home of an episode, and texts about the home."""

    def __init__(self, episode: Any, number: int, *, places: bool) -> None:
        """Describe a home for one agent.

        Args:
            episode: Episode that is played.
            number: Number of the agent.
            places: True if the agent chooses where things go; otherwise each thing has one goal.
        """
        self._home: Home = home_of(episode.scene, episode.spec.open_m)
        self._layout: Layout = self._home.layout
        self._agents = [member.name for member in episode.roster]
        self._kinds = [member.kind for member in episode.roster]
        self._number, self._goals = number, () if places else tuple(t.destination for t in episode.targets)
        home, things = self._home, tuple(target.name for target in episode.targets)
        furniture = tuple(dict.fromkeys((*home.surfaces, *home.enclosed)))
        where = (*furniture, *self._layout.rooms) if places else ()
        others = tuple(name for k, name in enumerate(self._agents) if k != number)
        self.names = Names(things, where, tuple(self._layout.rooms), joint_names(episode.scene), others)
        self._furniture = furniture

    def home(self) -> str:
        """Return a text about rooms with furniture, doors and drawers, which does not change during an episode."""
        lines = ["The home, room by room, with furniture on which things can be put:"]
        opens: dict[str, list[str]] = {}
        for joint in self.names.openings:
            thing, _, part = joint.rpartition("/")
            opens.setdefault(thing, []).append(part)
        for room in self._layout.rooms:
            inside = [name for name in self._furniture if self._room_of(self._layout.furniture[name].center) == room]
            words = room_words(room)
            called = "" if words == room else f" ({words})"
            lines.append(f"- {room}{called}: {', '.join(inside) or 'nothing'}")
        if opens:
            lines.append("Doors and drawers:")
            lines += [f"- {thing}/: {', '.join(parts)}" for thing, parts in opens.items()]
        return "\n".join(lines)

    def state(self, view: RearrangeView, notes: Iterable[str] = ()) -> str:
        """Return a text about everything that the agent knows now, including its own ``notes``."""
        held = [name for name, by in zip(self.names.things, view.held_by, strict=True) if by == self._number]
        room = self._room_of((view.xz[0], 0.0, view.xz[1]))
        hand = f"holds {held[0]}" if held else "is empty"
        lines = [f"You are {self._agents[self._number]}, in {room or 'a doorway'}; your hand {hand}."]
        if len(self._agents) == 2 and np.isfinite(view.other_xz).all():
            other = self._room_of((view.other_xz[0], 0.0, view.other_xz[1]))
            lines.append(f"{self.names.agents[0]} is in {other or 'a doorway'}.")
        lines.append("Things:")
        for k, name in enumerate(self.names.things):
            kind = spoken(self._home.categories.get(name, name))
            goal = f"; its goal is {self._called(self._goals[k])}" if self._goals else ""
            reached = " (it is there)" if self._goals and view.at_goal[k] else ""
            lines.append(f"- {name} ({kind}): {self._where(view, k)}{goal}{reached}")
        said = [line_of(event, self._agents) for event in view.messages[-MESSAGES:]]
        return "\n".join([*lines, *(["Said so far:", *said] if said else []), *notes])

    def place_of(self, point: Any) -> str:
        """Return words for the place of a world point [3] [m]: the furniture that it is on or in, and the room."""
        (on, inside), room = self.surface_of(point), self._room_of(point)
        where = f"{'inside' if inside else 'on'} {on}" if on else "on the floor"
        return f"{where}, in {room}" if room else where

    def surface_of(self, point: Any) -> tuple[str, bool]:
        """Return the furniture on which a world point [3] [m] lies ("" for none), and whether it is in a closed space.

        Closed spaces are those behind a door or in a drawer.
        """
        x, y, z = (float(value) for value in point)
        best, found = np.inf, ("", False)
        for name, box in self._layout.furniture.items():
            for surface in box.surfaces:
                above = y - surface.center[1]
                if -OVER_M <= above < min(surface.clearance, best) and _covers(surface, x, z):
                    best, found = above, (name, surface.inside)
        return found

    def has_place(self, place: str) -> bool:
        """Return whether things can be put at the place of a `Destination`."""
        home = self._home
        if place.startswith(FLOOR):
            return place.removeprefix(FLOOR) in self._layout.rooms
        if place.startswith(INSIDE):
            return place.removeprefix(INSIDE) in home.enclosed
        return place in home.surfaces or place in home.rooms.values()

    def _where(self, view: RearrangeView, k: int) -> str:
        holder = int(view.held_by[k])
        if holder != NOBODY:
            return "in your hand" if holder == self._number else f"in the hand of {self._agents[holder]}"
        return self.place_of(view.objects[k]) if view.is_known(k) else "you have not seen where it is"

    def _called(self, destination: str) -> str:
        name = destination.partition("|")[0].partition("/")[0]
        box = self._layout.furniture.get(name)
        room = self._room_of(box.center) if box is not None else ""
        return f"{name}{f' in {room}' if room else ''}"

    def _room_of(self, point: Any) -> str:
        x, _, z = point
        rooms = self._layout.rooms.items()
        return next((r for r, parts in rooms if any(a <= x <= c and b <= z <= d for a, b, c, d in parts)), "")

    def is_in(self, point: Any, room: str) -> bool:
        """Return whether a world point [3] [m] is in a room."""
        return self._room_of(point) == room


def line_of(event: Event, names: list[str]) -> str:
    """Return a message as one line with its sender and its text."""
    return f"{names[event.agent] if 0 <= event.agent < len(names) else '?'}: {event.detail}"


def _covers(surface: Surface, x: float, z: float) -> bool:
    dx, dz = x - surface.center[0], z - surface.center[2]
    c, s = np.cos(surface.heading), np.sin(surface.heading)
    return bool(abs(c * dx - s * dz) <= surface.half[0] and abs(s * dx + c * dz) <= surface.half[1])
