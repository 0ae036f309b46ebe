"""Drivers, which convert messages of players to commands of the simulator; each played agent has one.

A driver depends only on the messages and the world, so that the same messages give the same commands when a session
continues after a crash.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from h3data.bodies.people.gestures import GESTURES, NAMES, add_gestures
from h3data.bodies.people.reach import hand_points
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, Array, heading_from_quat, quat_from_matrix
from h3data.scene import FreeSpace
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
from sim_kinematic.agents.skills import Action, Message, sentence
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.tasks.sessions import Session, StepResult

CANCEL = Action("wait", steps=1)
"""Action that interrupts a running skill and has no other effect."""
DOOR_SHUT = "A closed door is in the way."
MOST_UNSAID = 5
"""Largest number of text messages of a player that wait to be sent; one is sent in each step."""
GOAL_M = 0.02
"""Distance from an object's goal within which a chosen place means the goal [m]."""

WAVES = 3
"""Number of strokes of a waving hand."""
OFFER_STEPS = 15
"""Number of steps between two searches for seats and things that the player could use."""
AHEAD_M = 5.0
"""Distance within which one seat after the other is searched for room, one in a step, before the player comes near [m]."""
PHONE = "phone"
"""Name of the gesture and of the chore of looking at a phone."""


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

    def can_place(self, point: Any) -> str:
        """Return the reason why the held object could not be placed at a point now; empty if it could."""
        return "There is nothing to place here."

    # --- the body -----------------------------------------------------------------------------------------------------
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
        team = self.session.play.team
        actor = team.actors[self.number]
        return team.door_before(actor, partial(actor.stands_on, point=point))

    def go(self, xz: Any, heading: float | None = None) -> str:
        """Walk or drive to a floor point, unless a closed door is in between."""
        team = self.session.play.team
        spot = team.doorways.open_floor.snap(xz, max_distance_m=FLOOR_SNAP_M)
        place = np.array([[*spot, 0.0]])[np.isfinite(spot).all(keepdims=True)]
        if team.door_before(team.actors[self.number], lambda _: place) >= 0:
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
        self._seats, self._sought, self._place = 0, -OFFER_STEPS, b""
        """Flags of the seats that are near, and the step and the places of people for which they were sought."""
        self._chores: list[dict[str, str]] = []
        self._new_seats = [
            (seat.edge[[0, 2]], lies) for seat in seats_of(session.episode.scene) for lies in (False, True)
        ]
        """Edges (x, z) of the seats that have not been searched, and whether for room to lie there."""

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
            if self.gesture == "wave" and seconds >= WAVES * gesture.seconds:
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
        return 0 if self.busy or self.hands_full else CAN_GESTURE | self._seats

    @property
    def chores(self) -> list[dict[str, str]]:
        """Return the chores that the player could start now, each with its name and the kind of the thing."""
        self._seek()
        return [] if self.busy else self._chores

    def _seek(self) -> None:
        """Search for seats and chores near a player whose body is free, if the last search is old enough."""
        step = len(self.session.recorder)
        if self.busy or step == self._sought:
            return
        self._search_ahead()
        if step < self._sought + OFFER_STEPS:
            return
        self._sought, team = step, self.session.play.team
        seated = [actor.seat.taken for actor in team.actors if getattr(actor, "seat", None) is not None]
        place = b"".join(part.tobytes() for part in (self.body.xz, *seated))
        # where nobody has moved, the search would find the same seats
        if place != self._place and not self.hands_full:
            able = {flag: not self.session.refusal(self.name, SitSkill(flag == LIES)) for flag in (SITS, LIES)}
            self._seats, self._place = sum(flag for flag in able if able[flag]), place
        if self.hold is not None:
            self._chores = [{"name": name, "thing": thing} for name, thing in self.hold.offers(self.body)]

    def _search_ahead(self) -> None:
        """Search one new seat near the player, so that the seats that come within reach are known."""
        gaps = [math.hypot(*(edge - self.body.xz)) for edge, _ in self._new_seats]
        if gaps and min(gaps) < AHEAD_M and self.body.seats is not None:
            edge, lies = self._new_seats.pop(gaps.index(min(gaps)))
            # 0.01: only this seat
            self.body.seats.nearest(edge, within_m=0.01, lies=lies)

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
