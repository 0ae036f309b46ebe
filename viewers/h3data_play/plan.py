"""Plan of games, which the command line makes for the front process and the workers; it never comes from a client."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

SEATS = ("person", "robot", "spectator")
"""Kinds of seats that a person at a browser can take."""
VERSION = 1
"""Version of the protocol between page and server; the page refuses others."""


class PlayPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Plan of the episodes that are played at one table."""

    app: str
    """Name of an app, or ``module:Class``."""
    out: str
    """Folder of the recordings."""
    seats: tuple[str, ...] = ("person",)
    """Roles of the seats, from `SEATS`; players first."""
    partner: str | None = None
    """Policy of all agents without a player; None selects the task's default."""
    scenes: str | tuple[str, ...] = "small"
    seed: int = 0
    episodes: int = 1
    speed: float = 1.0
    """Speed of the clock relative to real time (1), for scripted players; 0 means as fast as possible. Recordings store
    it."""
    weights_in: str = ""
    """Folder to which a path of weights in ``partner`` is relative. Recordings contain the relative path."""
    motion: str | None = None
    """Motion file with the gait of people; None for the default gait."""
    human: str = ""
    """Body of people, with motions that they perform (`h3data.bodies.load_humanoid`); empty for the default body."""
    rules: dict[str, Any] = {}
    """Rules of the task that replace those of the app."""
    names: bool = False
    """True if a name stands over the head of every other agent, also where the app has none."""

    @property
    def partner_here(self) -> str | None:
        """Policy in `partner`, where the path of a weights file is valid on this machine."""
        from sim_kinematic.policies.learned import PREFIX as WEIGHTS  # the server's process imports no simulator

        if self.partner is None or not self.weights_in or not self.partner.startswith(WEIGHTS):
            return self.partner
        return f"{WEIGHTS}{Path(self.weights_in, self.partner.removeprefix(WEIGHTS))}"

    @property
    def players(self) -> tuple[str, ...]:
        """Seats that move an agent, without spectators."""
        return tuple(seat for seat in self.seats if seat != "spectator")

    def roster(self, usual: tuple[str, ...]) -> tuple[str, ...]:
        """Return the kinds of the agents, robots first: those in ``usual``, and more if there are more players.

        No agent is added to people who play alone or among themselves (partner ``solo``, or two people and no partner).
        """
        people, robots = (self.players.count(kind) for kind in ("person", "robot"))
        among_themselves = self.partner == "solo" or (people > 1 and self.partner is None)
        robots = max(robots, 0 if among_themselves else usual.count("robot"))
        people = max(people, 0 if self.partner == "solo" and robots else usual.count("human"))
        return ("robot",) * robots + ("human",) * people


class GameOrder(msgspec.Struct, frozen=True, kw_only=True):
    """Order to play one game, which the front process sends to a worker."""

    index: int
    """Number of the episode in the sequence that follows from the plan's seed."""
    name: str
    """Path of the game's recording in the plan's folder, without its file name ending."""
    plan: int = 0
    """Index of the game's plan among the plans of the worker."""
    info: dict[str, Any] = {}
    """Additional entries of the recording's ``info``."""
    hitl: dict[str, Any] = {}
    """Additional entries of the recording's ``info["hitl"]``."""
    resumes: bool = False
    """True if another process may already have played some or all of the game."""
    facts: dict[str, Any] | None = None
    """Facts computed when the episode was prepared (`EpisodeCodec.precompute`); None if it has not been prepared."""


def prepared_key(order: GameOrder) -> str:
    """Return the key of an episode's prepared data, which does not depend on its players."""
    return f"{order.plan}/{order.index}"


def recording_name(index: int) -> str:
    """Return the file name of an episode's recording, without its ending."""
    return f"{index:06d}"
