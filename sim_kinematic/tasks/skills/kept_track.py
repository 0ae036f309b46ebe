"""Recorded tracks of people with skills, which they follow regardless of the robots."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array, pose_inverse, pose_multiply
from h3data.recording import Recording
from h3data.recording.records import JOINTS
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.skills import Action, Objects, Skill, SkillResult
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.tasks.play import WorldRollout


@dataclass(frozen=True, kw_only=True, eq=False)
class SkillTrack:
    """Recorded track of one person with skills."""

    base: Array
    """Pose (pose7) of the agent root in each step [T, 7]."""
    root: Array
    """Pose (pose7) of the pelvis in the world in each step, [T, 7]."""
    joints: Array
    """Local rotations (quaternions) of the other joints in each step, [T, 54, 4]."""
    held: NDArray[np.integer]
    """Index of the object in the hand in each step, [T]; -1: none."""
    objects: Array
    """Pose (pose7) of each object of the task in each step, [T, K, 7]."""
    led: dict[int, list[tuple[int, float]]] = field(default_factory=dict)
    """Doors and drawers that the person opened or closed: number and position [rad or m] of each, by step."""

    @classmethod
    def of(cls, recording: Recording, number: int, bodies: NDArray[np.integer]) -> SkillTrack:
        """Return the track of an agent; ``bodies`` [K + 1] are the bodies of the objects, with -1 at the end.

        Raises:
            InputError: The body was not recorded at every step.
        """
        names = [f"agent_{number}.{name}" for name in ("base_pose", "root_pose", "joint_quat", "grasp_body")]
        lacks = [name for name in (*names, "object_pose") if name not in recording.columns]
        if lacks or not len(recording):
            raise InputError(
                f"There is no track of agent_{number} to keep; the recording lacks: {', '.join(lacks) or 'steps'}.",
                code="H3-TASK-013",
            )
        base, root, joints, grasp = (recording.columns[name] for name in names)
        # without the things of chores, which come last and are absent at times
        objects = recording.columns["object_pose"][:, : len(bodies) - 1]
        shapes = {(7,): (base, root), (54, 4): (joints,), (): (grasp,), (len(bodies) - 1, 7): (objects,)}
        if any(a.shape[1:] != shape or not np.isfinite(a).all() for shape, some in shapes.items() for a in some):
            raise InputError(
                f"The track of agent_{number} must be finite at every step, in columns of the usual shapes.",
                code="H3-TASK-014",
            )
        held = np.array([np.flatnonzero(bodies == body)[0] if body in bodies else -1 for body in grasp.tolist()])
        return cls(
            base=base.astype(np.float64),
            root=root.astype(np.float64),
            joints=joints.astype(np.float64),
            # the last of the bodies is -1, that of an empty hand
            held=np.where(held == len(bodies) - 1, -1, held),
            objects=objects.astype(np.float64),
            led=_led(recording, number),
        )


def _led(recording: Recording, number: int) -> dict[int, list[tuple[int, float]]]:
    """Return joints that an agent led, with their positions, by step."""
    positions = recording.columns.get(JOINTS)
    if positions is None:
        return {}
    led: dict[int, list[tuple[int, float]]] = {}
    targets = recording.columns[f"agent_{number}.skill_target"]
    for span in recording.skills:
        if span.agent == number and span.name in ("open", "close"):
            k = int(targets[span.start_step])
            for step in range(span.start_step, span.end_step + 1):
                if 0 <= k < positions.shape[1]:
                    led.setdefault(step, []).append((k, float(positions[step, k])))
    return led


def follow_track(play: WorldRollout, actor: PersonActor, track: SkillTrack, step: int) -> None:
    """Let a person follow a track from ``step`` to its end, without asking a policy."""
    # the person reacts to nobody any more, so a pair has nothing to agree on
    if len(play.team.actors) == 2:
        play.team.company.right_of_way, play.team.company.agreed = None, False
        for other in play.team.actors:
            other.aside = None
    actor.person.held.clear()
    actor.yields = False
    play.team.company.end_turn(actor.number)
    play.policies[actor.number] = play.policies[actor.number]._replace(policy=_Silent())
    play.team.controllers[actor.number].follow(_following(actor, track, step), step)


class _Silent:
    """Policy of a person on a track, which never interrupts and is asked only after the end."""

    def act(self, view: object) -> Action:
        return Action("wait")

    def interrupts(self, view: object) -> str:
        return ""


def _following(actor: PersonActor, track: SkillTrack, first: int) -> Skill:
    """Pose a person by a track from step ``first`` on, one step at a time."""
    for step in range(first, len(track.base)):
        # recorded in the world, while the person takes a pose relative to its base
        pelvis = pose_multiply(pose_inverse(track.base[step]), track.root[step])
        actor.person.set_pose(np.vstack([pelvis[3:], track.joints[step]]), pelvis[:3], track.base[step])
        for joint, position in track.led.get(step, ()):
            if actor.openables is not None:
                actor.openables.move(joint, position)
        _handle(actor.objects, actor.number, track, step)
        yield
    return SkillResult("done")


def _handle(objects: Objects, number: int, track: SkillTrack, step: int) -> None:
    """Take, carry and put down objects as recorded; an object that is elsewhere, or in another's hand, stays there."""
    mine, wanted = objects.held(number), int(track.held[step])
    if mine >= 0 and wanted != mine:
        objects.held_by[mine], objects.poses[mine] = NOBODY, track.objects[step, mine]
    # largest distance of an object from its recorded place at which the person takes it [m]
    there_m = 0.01
    if wanted >= 0 and wanted != mine and objects.held_by[wanted] == NOBODY:
        # one step before: in this one the object is in the recorded hand already
        lay = track.objects[max(step - 1, 0), wanted, :3]
        if np.linalg.norm(objects.poses[wanted, :3] - lay) <= there_m:
            objects.held_by[wanted] = number
    if wanted >= 0 and objects.held_by[wanted] == number:
        objects.poses[wanted] = track.objects[step, wanted]
