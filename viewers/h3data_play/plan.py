"""Plan of games: made by the command line, read by the front and by workers. It never comes from a client."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

SEATS = ("person", "robot", "spectator")
"""Kinds of seats that a person can take."""
VERSION = 1
"""Version of the protocol between page and server; the page refuses others."""


class PlayPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Episodes for one table of players."""

    app: str
    """Name of an app, or ``module:Class``."""
    out: str
    """Folder of the recordings."""
    seats: tuple[str, ...] = ("person",)
    """Roles of the seats, from `SEATS`; players first."""
    partner: str | None = None
    """Policy of all agents that nobody plays; None: the task's default."""
    scenes: str | tuple[str, ...] = "small"
    seed: int = 0
    episodes: int = 1
    speed: float = 1.0
    """Speed of the clock, for scripted players: above 1 it runs faster, 0 means as fast as the machine can. Recordings
    state it."""
    weights_in: str = ""
    """Folder to which a path of weights in ``partner`` is relative. Recordings repeat the relative path."""
    motion: str | None = None
    """Motion file of people's gait."""
    rules: dict[str, Any] = {}
    """Rules of the task that differ from the app's."""

    @property
    def partner_here(self) -> str | None:
        """Policy `partner`, with the path of a file of weights on this machine."""
        from sim_kinematic.policies.learned import PREFIX as WEIGHTS  # the server's process imports no simulator

        if self.partner is None or not self.weights_in or not self.partner.startswith(WEIGHTS):
            return self.partner
        return f"{WEIGHTS}{Path(self.weights_in, self.partner.removeprefix(WEIGHTS))}"

    @property
    def players(self) -> tuple[str, ...]:
        """Seats of the players."""
        return tuple(seat for seat in self.seats if seat != "spectator")

    def roster(self, usual: tuple[str, ...]) -> tuple[str, ...]:
        """Return the kinds of the agents, robots first: ``usual``, with further ones if more are played.

        No agent is added to people who play alone or among themselves (partner ``solo``, or two people and no partner).
        """
        people, robots = (self.players.count(kind) for kind in ("person", "robot"))
        among_themselves = self.partner == "solo" or (people > 1 and self.partner is None)
        robots = max(robots, 0 if among_themselves else usual.count("robot"))
        people = max(people, 0 if self.partner == "solo" and robots else usual.count("human"))
        return ("robot",) * robots + ("human",) * people


class GameOrder(msgspec.Struct, frozen=True, kw_only=True):
    """Order of one game, from the front to a worker."""

    index: int
    """Number of the episode in the run of the plan's seed."""
    name: str
    """Path of the game's recording in the plan's folder, without the ending."""
    plan: int = 0
    """Number of the game's plan among those that the worker was started with."""
    info: dict[str, Any] = {}
    """Further entries of the recording (``info``)."""
    hitl: dict[str, Any] = {}
    """Further entries of the recording in ``info["hitl"]``."""
    resumes: bool = False
    """True if another process may have played a part of it, or all."""
    facts: dict[str, Any] | None = None
    """Facts that were found when the episode was prepared (`EpisodeCodec.precompute`); None: it has not been prepared."""


def prepared_key(order: GameOrder) -> str:
    """Return the name of what has been prepared for an episode, whoever plays it."""
    return f"{order.plan}/{order.index}"


def recording_name(index: int) -> str:
    """Return the file name of an episode's recording, without its ending."""
    return f"{index:06d}"
