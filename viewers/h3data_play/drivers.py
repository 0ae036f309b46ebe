"""Drivers, which convert messages of players to commands of the simulator; each played agent has one.

A driver depends only on the messages and the world, so that the same messages give the same commands when a session
continues after a crash.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from h3data.bodies import Humanoid
from h3data.bodies.people.gestures import GESTURES, NAMES, add_gestures
from h3data.bodies.people.reach import hand_points
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, heading_from_quat, quat_from_matrix, wrap_angle
from h3data.replay.posed_recording import RAMP_S
from h3data.scene import FreeSpace, Scene
from h3data.scene.seats import seats_of
from h3data_play.guide import FLOOR_SNAP_M, Guide
from h3data_play.messages import (
    Act,
    Chore,
    Close,
    Drop,
    Gesture,
    Give,
    GoTo,
    Hand,
    Head,
    Leave,
    Move,
    Open,
    Perform,
    Pick,
    Place,
    Remark,
    Say,
    Sit,
    Stop,
)
from h3data_play.wire import GESTURES as CAN_GESTURE
from h3data_play.wire import LIES, SEATED, SITS
from sim_kinematic.agents.driven.commands import Chore as ChoreSkill
from sim_kinematic.agents.driven.commands import Drop as DropSkill
from sim_kinematic.agents.driven.commands import HandOver, HandTarget, PersonCommand
from sim_kinematic.agents.driven.commands import Place as PlaceSkill
from sim_kinematic.agents.driven.commands import Sit as SitSkill
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.skills import CHORE, CHORES, Action, Message, sentence
from sim_kinematic.crowd.errands import Motion
from sim_kinematic.crowd.seating import APART_M, LIES_APART_M, SeatPlace, Seats, leave, remain
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.policies.policy import PoseAction, Velocity
from sim_kinematic.tasks.sessions import Session, StepResult

CANCEL = Action("wait", steps=1)
"""Action that interrupts a running skill and has no other effect."""
DOOR_SHUT = "A closed door is in the way."
MOST_UNSAID = 5
"""Largest number of text messages of a player that wait to be sent; one is sent in each step."""
GOAL_M = 0.02
"""Distance from an object's goal within which a chosen place means the goal [m]."""

PHONE = "phone"
"""Name of the gesture and of the chore of looking at a phone."""
WAVES = 3
"""Number of strokes of a waving hand."""
LASTS_S = {"wave": WAVES * GESTURES["wave"].seconds, PHONE: math.inf}
"""Duration of each gesture of a player [s]; one without an end lasts until the player ends it."""
FADE_STEPS = round(RAMP_S / STEP_S)
"""Number of steps in which the hands leave a gesture."""
SETTLE_STEPS = 20
"""Number of steps in which the feet of somebody who stops come to stand."""
OFFER_STEPS = 15
"""Number of steps between two searches for seats and things that the player could use."""
AHEAD_M = 5.0
"""Distance within which one seat after the other is searched for room, one in a step, before the player comes near [m]."""
ARRIVED_M = 0.1
"""Distance from the place before a seat within which a person begins to sit down [m]."""


class Driver:
    """Driver of an agent that walks by keys or to a point of the floor, for tasks without skills."""

    def __init__(self, session: Session, number: int) -> None:
        self.session, self.number = session, number
        self.name = session.episode.roster[number].name
        self.ack = -1
        """Number of the last message that has acted."""
        self.forward, self.turn = 0.0, 0.0
        self.guide: Guide | None = None

    # --- from the player ----------------------------------------------------------------------------------------------
    def take(self, message: Act, refusal: str = "") -> str:
        """Accept a message, which takes effect in the next step.

        Returns:
            A sentence for the player if the message cannot be carried out, or the app's ``refusal``.

        Raises:
            InputError: the message is not a command of this task; it must not be recorded.
        """
        why = refusal or self.follow(message)
        if message.seq is not None:
            self.ack = message.seq
        return why

    def follow(self, message: Act) -> str:
        """Carry out a message; return a sentence for the player if that is impossible."""
        if isinstance(message, Move):
            # float32, as it is recorded
            self.forward, self.turn = float(np.float32(message.f)), float(np.float32(message.t))
            if message.f or message.t:
                self.interrupt()
            return ""
        if isinstance(message, Stop):
            self.interrupt()
            return ""
        if isinstance(message, Leave | Remark):
            return ""
        if isinstance(message, GoTo):
            self.interrupt()
            return self.go(message.p[::2])
        raise InputError(f"This cannot be done here: {type(message).__name__.lower()}.", code="H3-PLAY-013")

    def release(self) -> None:
        """Release all keys of a player who has left.

        The world stands still until the player returns, so skills and guided walks may continue later.
        """
        self.forward = self.turn = 0.0

    def interrupt(self) -> None:
        """End the running skill or guided walk."""
        self.guide = None

    def go(self, xz: Any, heading: float | None = None) -> str:
        """Start a guided walk to a floor point (x, z) [m]; return the reason if that is impossible."""
        try:
            self.guide = Guide.to(self.floor, self.base, self.place[0], xz, heading=heading)
        except InputError as fault:
            return str(fault)
        return ""

    # --- to the world -------------------------------------------------------------------------------------------------
    def command(self) -> Any:
        """Return the command for the next step; None to continue the last one."""
        return Velocity(*self.velocity())

    def velocity(self) -> tuple[float, float]:
        """Return the forward velocity and the turn of the next step, each from -1 to 1."""
        if self.guide is not None:
            velocity = self.guide.velocity(*self.place)
            if velocity is not None:
                return velocity
            self.guide = None
        return self.forward, self.turn

    def after(self, result: StepResult) -> str:
        """Handle the end of a step; return a sentence for the player."""
        return result.refused.get(self.name, "")

    @property
    def busy(self) -> bool:
        """Return whether the agent is moved by a skill or guided walk instead of the player's keys."""
        return self.guide is not None

    @property
    def offers(self) -> int:
        """Return the flags of the postures that are possible now (`h3data_play.wire.SITS` and the flags after it)."""
        return 0

    @property
    def chores(self) -> list[dict[str, str]]:
        """Return the chores that are possible now, each with its ``name`` and the kind of the ``thing``."""
        return []

    @property
    def activity(self) -> tuple[str, float, float] | None:
        """Return the activity that the columns do not show: its name, and the times since its start and to its end [s]."""
        return None

    def can_place(self, point: Any) -> str:
        """Return the reason why the held object could not be placed at a point now; empty if it could."""
        return "There is nothing to place here."

    # --- the body -----------------------------------------------------------------------------------------------------
    @property
    def acts(self) -> dict[str, Any]:
        """Captured motions of the person by name."""
        return acts_of(self.session, self.number)

    def act(self, name: str) -> Any:
        """Return a captured motion.

        Raises:
            InputError: the person has no motion of this name.
        """
        if name not in self.acts:
            raise InputError(f"There is no motion {name!r} of this person.", code="H3-PLAY-030")
        return self.acts[name]

    @property
    def place(self) -> tuple[Array, float]:
        """Return the position (x, z) [m] and the heading [rad] of the agent."""
        recorder = self.session.recorder
        if recorder.latest is None:
            start = self.session.episode.starts[self.number]
            return start[:2].copy(), float(start[2])
        pose = recorder.latest_columns()[f"agent_{self.number}.base_pose"][-1].astype(np.float64)
        return pose[[0, 2]], float(heading_from_quat(pose[3:]))

    @property
    def floor(self) -> FreeSpace:
        """Free floor on which paths are planned."""
        return self.session.episode.floor(self.number)

    @property
    def base(self) -> BaseSpec:
        """Discs and limits with which the agent moves."""
        return driving_base(self.session, self.number)


class SeatSearch:
    """Search for the seats that a player could use: one seat in a step, since a search may take 50 ms."""

    def __init__(self, scene: Scene, seats: Seats | None) -> None:
        self.flags = 0
        """Flags `SITS` and `LIES` of the last search."""
        self._seats, self._sought, self._place = seats, -OFFER_STEPS, b""
        """Seats of the home for the person, and the step and the places of people of the last search."""
        self._new = [(seat.edge[[0, 2]], lies) for seat in seats_of(scene) for lies in (False, True)]
        """Edges (x, z) of the seats that have not been searched, and whether for room to lie there."""

    def is_due(self, step: int, xz: Array) -> bool:
        """Search one new seat near a place (x, z), and return whether it is time to ask for the nearest seat."""
        if step == self._sought:
            return False
        gaps = [math.hypot(*(edge - xz)) for edge, _ in self._new]
        if gaps and min(gaps) < AHEAD_M and self._seats is not None:
            edge, lies = self._new.pop(gaps.index(min(gaps)))
            # 0.01: only this seat
            self._seats.nearest(edge, within_m=0.01, lies=lies)
        if step < self._sought + OFFER_STEPS:
            return False
        self._sought = step
        return True

    def ask(self, xz: Array, taken: Sequence[Array], can_use: Callable[[bool], bool]) -> None:
        """Update the flags of a player at a place (x, z), while others have ``taken`` seats; ``can_use`` tells of lying."""
        place = b"".join(part.tobytes() for part in (xz, *taken))
        # where nobody has moved, the search would find the same seats
        if place != self._place:
            self.flags = sum(flag for flag in (SITS, LIES) if can_use(flag == LIES))
            self._place = place


@dataclass
class Doing:
    """Gesture or motion of a player in a task without skills, which recordings and states show by its name."""

    name: str
    left: float
    """Number of steps until it ends, infinite for one that a player ends."""
    fades: int = FADE_STEPS
    """Number of steps in which the body goes back to standing."""
    waits: int = 0
    """Number of steps until the feet of somebody who has walked stand."""
    steps: int = 0
    """Number of steps so far."""

    def fade(self) -> None:
        """End as soon as the body stands again."""
        self.left = min(self.left, self.fades)

    def go_on(self) -> bool:
        """Count one step more, and return whether it still lasts."""
        self.steps, self.left = self.steps + 1, self.left - 1
        return self.left >= 0


class SittingDriver(Driver):
    """Driver of a person in tasks without skills, who also sits and lies down, makes gestures, and plays captured motions."""

    def __init__(self, session: Session, number: int) -> None:
        super().__init__(session, number)
        episode, body = session.episode, session.episode.roster[number].body
        assert isinstance(body, Humanoid)
        self.seats = Seats(episode.scene, episode.free, body)
        """Seats of the home for the person."""
        self.seat: SeatPlace | None = None
        """Seat that the person uses: they sit down, sit, or get up."""
        self._goal: SeatPlace | None = None
        """Seat to which the guided walk leads."""
        self._motion: Motion = iter(())
        self._waits: tuple[Array, float] | None = None
        """Next place and posture of a person who waits because another agent is in the way."""
        self._gets_up, self._why = False, ""
        self._search = SeatSearch(episode.scene, self.seats)
        self.doing: Doing | None = None
        """Gesture or captured motion that the person shows."""

    def follow(self, message: Act) -> str:
        """Carry out a message: sit, lie down, get up, make a gesture, or play a motion, as in tasks with skills."""
        if isinstance(message, Gesture | Perform):
            return self._do(message)
        if not isinstance(message, Sit):
            return super().follow(message)
        sits = self.seat is not None
        self.interrupt()
        place = None if sits else self.seats.nearest(self._state.xz[0], self.taken, lies=message.lies)
        if place is None:
            return "" if sits else sentence("no_seat")
        if self.doing is not None:
            self.doing.fade()
        why = self.go(place.before[:2], place.before.item(2))
        self._goal = None if why else place
        return why

    def interrupt(self) -> None:
        """End the guided walk and a captured motion, and get up."""
        super().interrupt()
        if self.doing is not None and self.doing.name in self.acts:
            self.doing.fade()
        self._goal = None
        if self.seat is not None and not self._gets_up:
            self._motion, self._gets_up = leave(self._here, self._state.seat.item(0, 1), self.seat), True
            self._waits = None

    def command(self) -> Velocity | PoseAction:
        """Return the command for the next step: the motion to or from a seat, or else a velocity."""
        if self.seat is None:
            velocity = self.velocity()
            if self._goal is None or self.guide is not None or self.doing is not None:
                return self._walking(*velocity)
            self._arrive(self._goal)
        moved = self._waits or next(self._motion, None)
        if self.seat is None or moved is None:
            self.seat = None
            return self._walking(*self.velocity())
        (place, share), own = moved, self._state
        discs = self.session.play.world.circles(self.number)[0]
        now, then = (np.hypot(*(discs[:, :2] - xz).T) for xz in (own.xz[0], place[:2]))
        # only those to whom the step leads: somebody who is too near already must not keep the person from leaving
        blocked = ((then < now) & (then < discs[:, 2] + self.base.disc_radius_m)).any()
        self._waits = moved if blocked else None
        if blocked:
            place, share = self._here, own.seat.item(0, 1)
        # headings are never wrapped
        heading = own.heading.item(0) + float(wrap_angle(place[2] - own.heading.item(0)))
        return PoseAction(place[:2], heading, (self.seat.seat.height_m, float(share)))

    def _walking(self, forward: float, turn: float) -> Velocity:
        """Return the command of a step in which the person stands or walks, and go on with what they show."""
        own = self.doing
        if own is not None and own.waits:
            own.waits -= 1
            return Velocity(0.0, 0.0)
        if own is None or not own.go_on():
            self.doing = None
            return Velocity(forward, turn)
        # a motion is played on the spot
        return Velocity(0.0, 0.0, own.name) if own.name in self.acts else Velocity(forward, turn, own.name)

    def _do(self, message: Gesture | Perform) -> str:
        """Begin a gesture or a captured motion, or end it; return the reason if that is impossible."""
        name, own = message.name, self.doing
        if own is not None and (own.name == name or own.name in self.acts):
            own.fade()
            return ""
        if self.seat is not None:
            return "Get up first."
        if isinstance(message, Gesture):
            self.doing = Doing(name, LASTS_S[name] / STEP_S + FADE_STEPS)
            return ""
        act = self.act(name)
        if not act.fits(self.floor, *self.place, self.session.play.world.circles(self.number)[0]):
            return sentence("no_room")
        moves = self.guide is not None or self.forward or self.turn or self._state.blend[0] > 0
        self.guide = self._goal = None
        self.doing = Doing(name, round(act.seconds / STEP_S), round(act.blend_s / STEP_S), SETTLE_STEPS if moves else 0)
        return ""

    @property
    def activity(self) -> tuple[str, float, float] | None:
        """Return the gesture or motion, with the times since its start and to its end [s]."""
        own = self.doing
        return None if own is None or not own.steps else (own.name, (own.steps - 1) * STEP_S, own.left * STEP_S)

    def _arrive(self, goal: SeatPlace) -> None:
        """Begin to sit down on a seat to which the guided walk has led, if it is still free."""
        self._goal = None
        if np.hypot(*(goal.before[:2] - self._state.xz[0])) > ARRIVED_M:
            return  # somebody or something was in the way
        try:
            self.seats.place(goal.seat, self.taken)
        except InputError:
            self._why = sentence("no_seat")
            return
        self.seat, self._gets_up, self._motion = goal, False, remain(self._here, goal)

    def after(self, result: StepResult) -> str:
        """Return a sentence for the player, such as why they cannot sit down after all."""
        why, self._why = self._why, ""
        return why or super().after(result)

    @property
    def busy(self) -> bool:
        """Return whether the person is led, plays a motion, sits or gets up."""
        moves = self.doing is not None and self.doing.name in self.acts
        return super().busy or self.seat is not None or moves

    @property
    def offers(self) -> int:
        """Return the flags of the postures that the player could take now."""
        if self.seat is not None:
            return SEATED
        if self.busy:
            return 0
        xz = self._state.xz[0]
        if self._search.is_due(len(self.session.recorder), xz):
            taken = self.taken
            self._search.ask(xz, taken, lambda lies: self.seats.nearest(xz, taken, lies=lies) is not None)
        return CAN_GESTURE | self._search.flags

    @property
    def taken(self) -> list[Array]:
        """Places ``(x, z, heading)`` of seats that others use or go to, and the distance to keep from them [m], [4] each."""
        play = self.session.play
        others = [own for k, own in enumerate(play.world.state.agents) if k != self.number]
        seated = [own for own in others if isinstance(own, HumanState) and own.seat[0, 1] > 0]
        apart = [APART_M if own.seat[0, 1] <= 1 else LIES_APART_M for own in seated]
        stations = [station.taken for who, station in play.team.stations.items() if who != self.number]
        return stations + [np.array([*own.xz[0], own.heading[0], m]) for own, m in zip(seated, apart, strict=True)]

    @property
    def _state(self) -> HumanState:
        own = self.session.play.world.state.agents[self.number]
        assert isinstance(own, HumanState)
        return own

    @property
    def _here(self) -> Array:
        return np.append(self._state.xz[0], self._state.heading)


class SkillDriver(Driver):
    """Driver of an agent that can also pick, place, hand over, open and close by skills, one after the other."""

    def __init__(self, session: Session, number: int) -> None:
        super().__init__(session, number)
        self.queue: list[Any] = []
        """Skills still to come."""
        self.cancelled = False
        self.unsaid: list[Message] = []
        """Messages to other agents that have not been said yet."""

    def follow(self, message: Act) -> str:
        """Carry out a message; pick, place, hand over, open and close start skills."""
        if isinstance(message, Say):
            said = Message(message.text, message.to)
            said.check([member.name for member in self.session.episode.roster])
            if len(self.unsaid) >= MOST_UNSAID:
                return "Wait a moment before you say more."
            self.unsaid.append(said)
            return ""
        if isinstance(message, Pick):
            names = self.objects.names
            if message.o >= len(names):
                raise InputError(f"There is no object {message.o}. Expected 0 to {len(names) - 1}.", code="H3-PLAY-017")
            if why := self.barred(message.o, message.lead):
                return why
            pick = Action("pick", message.o)
            return self.do([Action("nav_to_object", message.o), pick] if message.lead else [pick])
        if isinstance(message, Place):
            return self.put(np.array(message.p), message.lead)
        if isinstance(message, Open | Close):
            return self.turn_joint(message)
        if isinstance(message, Drop):
            return self.do([self.drop()])
        if isinstance(message, Give):
            if message.a >= len(self.session.episode.roster):
                raise InputError(f"There is no agent {message.a}.", code="H3-PLAY-018")
            return self.do([self.give(message.a)])
        return super().follow(message)

    def do(self, skills: list[Any]) -> str:
        """Start a sequence of skills."""
        self.interrupt()
        self.queue = skills
        return ""

    def put(self, point: Array, lead: bool) -> str:
        """Place the object in hand at a world point [3] [m]; with ``lead`` the agent walks there first."""
        k = self.objects.held(self.number)
        if k < 0:
            return "The hand holds nothing."
        if np.linalg.norm(point - self.objects.goals[k]) < GOAL_M:
            if why := self.barred(k, lead, at_goal=True):
                return why
            place = Action("place", k)
            return self.do([Action("nav_to_goal", k), place] if lead else [place])
        return self.put_at(point, lead)

    def turn_joint(self, message: Open | Close) -> str:
        """Open or close a door or drawer."""
        names = self.objects.joints
        if message.j >= len(names):
            raise InputError(f"There is no door or drawer {message.j}; the home has {len(names)}.", code="H3-PLAY-016")
        if self.objects.held(self.number) >= 0:
            return sentence("hand_full")
        openables = self.session.play.team.openables  # type: ignore[attr-defined]
        if message.lead and self.door_before(openables.handles(openables.positions)[message.j]) not in (-1, message.j):
            return DOOR_SHUT
        skill = Action("open" if isinstance(message, Open) else "close", message.j)
        return self.do([Action("nav_to_handle", message.j), skill] if message.lead else [skill])

    def barred(self, k: int, lead: bool, *, at_goal: bool = False) -> str:
        """Return the reason why object ``k`` is blocked until something is opened; empty if it is not.

        The object may be blocked for taking, or for placing at its goal (``at_goal``).
        """
        sight, openables = self.objects.sight, self.session.play.team.openables  # type: ignore[attr-defined]
        if sight is not None and not at_goal and not sight.known[self.number, k]:
            return sentence("not_seen")
        if openables is not None and openables.barrier_of(k, at_goal=at_goal) >= 0:
            return sentence("closed")
        point = self.objects.goals[k] if at_goal else self.objects.poses[k, :3]
        return DOOR_SHUT if lead and self.door_before(point) >= 0 else ""

    def door_before(self, point: Array) -> int:
        """Return the closed door between the agent and the places from which it could reach a point [3] [m], or -1."""
        return self._door_before(partial(self.session.play.team.actors[self.number].stands_on, point=point))

    def _door_before(self, stands: Callable[[FreeSpace], Array]) -> int:
        """Return the first closed door that blocks all poses ``stands`` [N, 3] on a given floor, or -1 if none does."""
        team, episode = self.session.play.team, self.session.episode
        if team.openables is None or not episode.spec.floor_moves:
            return -1
        positions = team.openables.positions
        if not team.doorways.any_closed(positions):
            return -1
        # any detour will do here: only a place without a path is blocked
        return team.doorways.first(team.actors[self.number].xz, stands, team.floor, positions, detour_m=np.inf)

    def go(self, xz: Any, heading: float | None = None) -> str:
        """Walk or drive to a floor point, unless a closed door is in between."""
        team = self.session.play.team
        spot = team.doorways.open_floor.snap(xz, max_distance_m=FLOOR_SNAP_M)
        place = np.array([[*spot, 0.0]])[np.isfinite(spot).all(keepdims=True)]
        if self._door_before(lambda _: place) >= 0:
            return DOOR_SHUT
        return super().go(xz, heading)

    def put_at(self, point: Array, lead: bool) -> str:
        """Place the object in hand at a point [3] [m] that is not its goal."""
        return "The robot puts things down at their goals only."

    def drop(self) -> Any:
        """Return the command that releases the object in hand."""
        raise InputError("The robot does not drop things.", code="H3-PLAY-014")

    def give(self, agent: int) -> Any:
        """Return the command that hands the object in hand to another agent."""
        raise InputError("The robot does not hand things over.", code="H3-PLAY-015")

    def interrupt(self) -> None:
        """Stop walking, cancel the running skill and drop all that are queued."""
        super().interrupt()
        self.cancelled = self.runs
        self.queue = []

    def command(self) -> Any:
        """Return the command of the next step; None to continue the running skill."""
        if self.unsaid:
            return self.speak()
        if self.cancelled:
            self.cancelled = False
            if self.queue:
                return self.queue.pop(0)
            return self.walking(self.forward, self.turn) if self.forward or self.turn else CANCEL
        if self.runs:
            return None
        velocity = self.velocity()
        if self.guide is None and self.queue:
            return self.queue.pop(0)
        return self.walking(*velocity)

    def speak(self) -> Any:
        """Return the command that sends the next text message."""
        return self.unsaid.pop(0).action

    def walking(self, forward: float, turn: float) -> Any:
        """Return the command of a step without a skill, from the forward velocity and the turn."""
        return Velocity(forward, turn)

    def velocity(self) -> tuple[float, float]:
        """Return the forward velocity and the turn of the next step; a failed walk drops the queued skills."""
        failed = self.guide
        velocity = super().velocity()
        if failed is not None and failed.failed:
            self.queue = []
        return velocity

    def after(self, result: StepResult) -> str:
        """Return a sentence about the last step for the player; a failed skill drops the queued ones."""
        # what a new command has interrupted is followed by what that command asked for
        own = [span for span in result.skills if span.agent == self.number and span.reason != "commanded"]
        if any(span.outcome in ("failed", "aborted") for span in own):
            self.queue = []
        return super().after(result)

    @property
    def runs(self) -> bool:
        """Return whether a skill is running."""
        return self.session.task.control.is_busy(self.session.play, self.number)

    @property
    def busy(self) -> bool:
        """Return whether a skill or walk is running or queued."""
        return self.runs or super().busy or bool(self.queue)

    @property
    def floor(self) -> FreeSpace:
        """Free floor on which the agent can move with the current state of doors."""
        return self.session.play.team.actors[self.number].free  # type: ignore[attr-defined]

    @property
    def objects(self) -> Any:
        """Objects of the episode, a `sim_kinematic.agents.skills.Objects`."""
        return self.session.play.team.objects  # type: ignore[attr-defined]


class PersonDriver(SkillDriver):
    """Driver of a person with hands and a head."""

    def __init__(self, session: Session, number: int) -> None:
        super().__init__(session, number)
        self.hands: dict[str, HandTarget] = {}
        self.head: tuple[float, float] | None = None
        self.gesture, self.gestured = "", 0
        """Name of the gesture, and number of its steps so far."""
        self._search = SeatSearch(session.episode.scene, self.body.seats)
        self._chores: list[dict[str, str]] = []

    def follow(self, message: Act) -> str:
        """Carry out a message; messages about hands and head set their targets."""
        if isinstance(message, Hand):
            if message.p is None:
                self.hands.pop(message.side, None)
            elif message.q is not None and np.linalg.norm(message.q) < 1e-3:
                raise InputError("Expected a quaternion other than zero for a hand.", code="H3-PLAY-019")
            else:
                self.hands[message.side] = HandTarget(message.p, message.q)
            return ""
        if isinstance(message, Head):
            self.head = message.yaw, message.pitch
            return ""
        if isinstance(message, Sit):
            sits = self.body.seat is not None
            self.do([])
            self.queue = [] if sits else [SitSkill(message.lies)]
            return ""
        if isinstance(message, Gesture) and message.name == PHONE and self.hold is not None:
            message = Chore(PHONE)
        if isinstance(message, Chore):
            return self.do([ChoreSkill(message.name)])
        if isinstance(message, Perform):
            if self.body.person.plays is not None:
                self.interrupt()
                return ""
            self.act(message.name)
            number = list(self.body.person.body.acts).index(message.name)
            return self.do([Action(CHORE, CHORES.index("perform"), command=(float(number),))])
        if isinstance(message, Gesture):
            if self.hands_full:
                return sentence("hand_full")
            self.gesture, self.gestured = "" if message.name == self.gesture else message.name, 0
            return ""
        return super().follow(message)

    def walking(self, forward: float, turn: float) -> PersonCommand:
        """Return the command for a velocity, with the targets of hands and head or those of a running gesture."""
        right, head = self.hands.get("right"), self.head
        if self.hold is not None and self.hold.shows_phone:
            head = head or (0.0, float(np.radians(GESTURES[PHONE].head_deg)))
        if self.gesture:
            gesture, seconds = GESTURES[self.gesture], self.gestured * STEP_S
            self.gestured += 1
            right = right or self.reach_of(seconds)
            head = head or (0.0, float(np.radians(gesture.head_deg)))
            if seconds >= LASTS_S[self.gesture]:
                self.gesture = ""
        return PersonCommand(forward, turn, self.hands.get("left"), right, head)

    def reach_of(self, seconds: float) -> HandTarget:
        """Return the target pose of the right hand at a time [s] of a standing person's gesture."""
        body = self.body.person.body
        quats, pelvis = (np.array(part) for part in body.clip_pose([0], [0.0]))
        add_gestures(body, quats, pelvis, [[NAMES.index(self.gesture), seconds, 1.0]])
        frames = body.joint_matrices(IDENTITY_POSE, quats, pelvis)
        wrist = quat_from_matrix(frames[0, JOINT_INDEX["right_wrist"], :3, :3])
        return HandTarget(tuple(hand_points(frames, body)[0].tolist()), tuple(wrist.tolist()))

    def put_at(self, point: Array, lead: bool) -> str:
        """Put the object in hand at a world point [3] [m]; with ``lead`` the person walks within reach first."""
        place = PlaceSkill(tuple(point.tolist()))
        if not lead:
            return self.do([place])
        stand = self.body.stand_for(point)
        if stand is None and self.door_before(point) >= 0:
            return DOOR_SHUT
        if stand is None:
            return "There is nowhere to stand from which it could be put there."
        self.do([place])
        return self.go(stand[:2], float(stand[2]))

    def drop(self) -> Any:
        """Return the skill that drops the object in hand."""
        return DropSkill()

    def give(self, agent: int) -> Any:
        """Return the skill that gives the object in hand to another agent."""
        return HandOver(agent)

    def can_place(self, point: Any) -> str:
        """Return the reason why the object in hand cannot be placed at a world point, as a sentence; empty if it can."""
        return self.session.refusal(self.name, PlaceSkill(tuple(point))) or ""

    @property
    def offers(self) -> int:
        """Return the flags of the postures that the player could take now, by the rules of the simulator."""
        if self.body.seat is not None:
            return SEATED
        self._seek()
        return 0 if self.busy or self.hands_full else CAN_GESTURE | self._search.flags

    @property
    def chores(self) -> list[dict[str, str]]:
        """Return the chores that the player could start now, each with its name and the kind of the thing."""
        self._seek()
        return [] if self.busy else self._chores

    def _seek(self) -> None:
        """Search for seats and chores near a player whose body is free, if the last search is old enough."""
        if self.busy or not self._search.is_due(len(self.session.recorder), self.body.xz):
            return
        if not self.hands_full:
            team = self.session.play.team
            taken = [actor.seat.taken for actor in team.actors if getattr(actor, "seat", None) is not None]
            self._search.ask(self.body.xz, taken, lambda lies: not self.session.refusal(self.name, SitSkill(lies)))
        if self.hold is not None:
            self._chores = [{"name": name, "thing": thing} for name, thing in self.hold.offers(self.body)]

    @property
    def hold(self) -> Any:
        """Hands of the person for chores; None in tasks whose rules have none."""
        return self.body.chores

    @property
    def hands_full(self) -> bool:
        """Return whether the person holds an object of the task, or a thing of a chore."""
        return self.objects.held(self.number) >= 0 or (self.hold is not None and self.hold.full)

    @property
    def busy(self) -> bool:
        """Return whether a skill or walk is running or queued, the person sits or gets up, or ends a chore."""
        return super().busy or self.body.leaving is not None

    @property
    def body(self) -> DrivenPerson:
        """Simulated person that the player moves."""
        return self.session.play.team.actors[self.number]  # type: ignore[attr-defined]


class RobotDriver(SkillDriver):
    """Driver of a robot with an arm, which its skills move."""

    def speak(self) -> Any:
        """Return the command that sends the next text message and restarts the running skill afterwards."""
        if self.runs:
            self.queue.insert(0, self.session.play.team.controllers[self.number].action)  # type: ignore[attr-defined]
        return super().speak()

    @property
    def base(self) -> BaseSpec:
        """Discs and limits of the robot's base, which also cover the object in hand."""
        return self.session.play.team.actors[self.number].base  # type: ignore[attr-defined]


def acts_of(session: Session, number: int) -> dict[str, Any]:
    """Return the captured motions of an agent by name, without those that have the name of a gesture."""
    actors: Any = getattr(session.play.team, "actors", None)
    # with skills, the hands for chores also play motions
    if actors is not None and getattr(actors[number], "chores", None) is None:
        return {}
    acts = getattr(session.episode.roster[number].body, "acts", {})
    return {name: act for name, act in acts.items() if name not in GESTURES}


def driving_base(session: Session, number: int) -> BaseSpec:
    """Return the discs and limits with which an agent moves by commands: a robot's base, or the disc of a person."""
    episode = session.episode
    if episode.roster[number].kind == "robot":
        return episode.bases[number]
    spec = episode.spec
    return BaseSpec(
        max_speed_mps=spec.human.speed_mps,
        max_turn_rad_s=spec.human.turn_rad_s,
        disc_offsets_m=(0.0,),
        disc_radius_m=spec.agent_radius_m,
        allow_back=session.task.control.has_skills,
    )
