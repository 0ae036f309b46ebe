"""Drawables of a recording and their poses at any step."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.gestures import GESTURES, NAMES, add_gestures, lead_hands
from h3data.bodies.people.planted_gait import drawn_in, planted_states, pose_planted
from h3data.bodies.people.rigid_parts import PeopleStyle, rigid_parts
from h3data.bodies.people.sitting import take_seats
from h3data.bodies.robots.trot import legs_are_posed, trot
from h3data.errors import FormatError, InputError
from h3data.geometry import Array, pose_to_matrix, smoothstep
from h3data.plugins import Registry, names_from_data
from h3data.recording import Agent, AssetRef, Body, Recording
from h3data.recording.assets.folders import clean_path
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.records import JOINTS
from h3data.render.light.sources import LightMode, check_light
from h3data.replay.recorded_robots import check_recorded_robots
from h3data.replay.records import (
    BodyTrack,
    Drawable,
    JointTrack,
    LinkTrack,
    PersonTrack,
    RigTrack,
    State,
    Track,
)
from h3data.scene import Mesh, Scene, load_scene
from h3data.scene.articulation import SceneJoints, joints_of
from h3data.scene.floor_heights import LEVEL, room_heights

_STAND_INS: Registry[Any] = Registry("h3data.stand_ins", {}, what="maker of stand-ins")


class PosedRecording:
    """Recording posed at any step.

    Args:
        recording: The recording.
        assets: Library or folders of the asset files of imported recordings. Missing files are replaced by striped
            placeholders and listed in `missing`.
        detail: True uses the full meshes of people, False the simplified ones. By default, images use the simplified
            mesh if it is sufficient for the camera (`Humanoid.light_enough`), and all other functions use the full one.
        people: Appearance of people: ``skin``, ``capsules`` (of contact tests) or ``bones``.
        stepping: If true, legs that were recorded in their resting posture trot (`h3data.bodies.robots.trot`), people
            who were recorded by clips walk with planted feet, and hands move in recorded activities
            (`recorded_gestures`). This affects the appearance only.
        light: Light in images: ``flat``, the same everywhere, or ``baked``, from windows, sun and lamps
            (`h3data.render.light`).
        stand_ins: True to replace missing assets by plain objects instead of striped placeholders: built-in robots and
            people in the recorded postures, and boxes with names (the group `h3data.stand_ins`). `recording` then names
            these bodies.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        assets: AssetLibrary | Sequence[str | Path] | None = None,
        detail: bool | None = None,
        people: PeopleStyle = "skin",
        stepping: bool = True,
        light: LightMode = "flat",
        stand_ins: bool = False,
    ) -> None:
        if not isinstance(recording, Recording):
            raise InputError(
                f"Expected a Recording, got {recording!r:.60}. Hint: h3data.open(PATH) reads recordings.",
                code="H3-REPLAY-021",
            )
        if people not in get_args(PeopleStyle):
            raise InputError(
                f"Unknown style of people {people!r}. Expected one of: {', '.join(get_args(PeopleStyle))}.",
                code="H3-REPLAY-022",
            )
        self.detail = detail
        self.people: PeopleStyle = people
        self.stepping = stepping
        check_light(light)
        self.light: LightMode = light
        self.library = assets if isinstance(assets, AssetLibrary) else AssetLibrary([Path(p) for p in assets or ()])
        if isinstance(source := recording.episode.info.get("source"), Mapping):
            self.library = self.library.with_own_folder(source.get("assets"))
        self.scene: Scene | None = None
        if "scene.glb" in recording.attachments:
            self.scene = self._read_scene(bytes(recording.attachments["scene.glb"]))
            # our own recordings carry their meshes in the scene, and need no asset library
            self.library = self.library.with_scene(self.scene)
        self.stand_ins = stand_ins
        recording, missing = (
            _STAND_INS.get("habitat").with_stand_ins(recording, self.library) if stand_ins else (recording, {})
        )
        self.recording = recording
        self._tracks: list[Track | None] = []
        self._drawables: list[Drawable] = []
        self._assets: dict[str, Mesh | None] = {}
        self.missing: dict[str, int] = missing
        """Number of bodies that refer to each asset file that was not found."""
        self._models: dict[int, Robot | Humanoid] = {}
        self._links: dict[int, LinkPoses] = {}
        self._gestures: dict[int, Array | None] = {}
        self._gaits: dict[int, tuple[Any, Array]] = {}
        self._joints = _recorded_joints(recording, self.scene)
        self._moved: tuple[bytes, Array] | None = None
        refs = {ref.name: ref for ref in recording.assets}
        rigs = {rig["body"]: rig for rig in recording.episode.info.get("rigs", ())}
        for body in recording.bodies:
            # a body with bones but without a skin in its file is rendered as a rigid mesh
            if body.name not in rigs or not self._add_rigged(body, refs[body.asset], rigs[body.name]):
                self._add_body(body, refs[body.asset])
        # before any pose: a robot whose model has changed would be shown with wrong joints
        check_recorded_robots(recording)
        for index, agent in enumerate(recording.agents):
            if agent.model:
                self._add_agent(index, agent)

    def _read_scene(self, glb: bytes) -> Scene:
        return load_scene(glb)

    # --- drawables ----------------------------------------------------------------------------------------------------
    @property
    def drawables(self) -> Sequence[Drawable]:
        """All drawables; the index is the id in instance images."""
        return self._drawables

    def __len__(self) -> int:
        return len(self.recording)

    @property
    def tracks(self) -> Sequence[Track | None]:
        """Recorded motion of each drawable; None = static."""
        return self._tracks

    def _add(self, drawable: Drawable, track: Track | None) -> None:
        self._drawables.append(drawable)
        self._tracks.append(track)

    def _add_body(self, body: Body, ref: AssetRef) -> None:
        if ref.name not in self._assets:
            self._assets[ref.name] = self.library.mesh(ref)
        mesh = self._assets[ref.name]
        missing = mesh is None
        # a body with recorded poses follows these: they include the motion of its door
        joint = -1 if self._joints is None or body.moving >= 0 else self._joints.owner.get(body.name, -1)
        track: Track | None = JointTrack(joint) if joint >= 0 else None
        if mesh is None:
            if self.stand_ins:
                mesh = _STAND_INS.get("habitat").named_box(clean_path(ref.uri))
            else:
                mesh = self.library.placeholder(ref, body)
            self.missing[ref.uri] = self.missing.get(ref.uri, 0) + 1
        self._add(
            Drawable(
                name=body.name,
                mesh=mesh,
                matrix=_matrix(body),
                layer=body.layer,
                semantic_id=body.semantic_id,
                agent=body.agent,
                moving=body.moving >= 0 or track is not None,
                placeholder=missing,
            ),
            BodyTrack(body.moving, body.scale) if body.moving >= 0 else track,
        )

    def _add_rigged(self, body: Body, ref: AssetRef, rig: Mapping[str, Any]) -> bool:
        """Add a body that is deformed by recorded bones; False if its file has no skin or the bones were not recorded."""
        column = f"rig.{rig['id']}"
        skin = self.library.skinned(ref) if column in self.recording.columns else None
        if skin is None:
            return False
        self._add(
            Drawable(
                name=body.name,
                mesh=skin.mesh,
                matrix=_matrix(body),
                layer=body.layer,
                semantic_id=body.semantic_id,
                agent=body.agent,
                moving=True,
                deformable=True,
            ),
            RigTrack(body, column, tuple(rig["bones"]), skin),
        )
        return True

    def _add_agent(self, index: int, agent: Agent) -> None:
        model = self.model(index)
        self._require_motion(index, model)
        common: dict[str, Any] = {"semantic_id": agent.semantic_id, "agent": index, "moving": True}
        if isinstance(model, Humanoid) and self.people == "skin":
            mesh = model.lod_mesh if self.detail is False else model.mesh
            self._add(
                Drawable(name=agent.name, mesh=mesh, matrix=np.eye(4), deformable=True, **common), PersonTrack(index)
            )
            return
        # drawables have their first pose, so that a still picture needs no more than the first row
        first = np.zeros(1, np.intp)
        links = rigid_parts(model, self.people) if isinstance(model, Humanoid) else model.links
        for number, link in enumerate(links):
            if link.mesh is not None:
                matrix = self.link_track(index, number, first)[0] if len(self) else np.eye(4)
                name = f"{agent.name}/{link.name}"
                self._add(
                    Drawable(name=name, mesh=link.mesh, matrix=matrix.astype(np.float64), **common),
                    LinkTrack(index, number),
                )

    def _require_motion(self, index: int, model: Robot | Humanoid) -> None:
        """Raise a FormatError if an agent has a model but lacks the columns that move it."""
        columns, prefix = self.recording.columns, f"agent_{index}."
        needed = ("motion_id", "motion_phase", "motion_blend")
        if isinstance(model, Robot):
            needed = ("joint_pos",)
        elif prefix + "joint_quat" in columns:
            needed = ("root_pose",)
        missing = [prefix + name for name in needed if prefix + name not in columns]
        if missing:
            agent = self.recording.agents[index]
            raise FormatError(
                f"Agent {agent.name!r} has the model {agent.model!r}, but the recording lacks the columns "
                f"{', '.join(missing)}. Hint: with an empty model, its recorded bodies are shown instead.",
                code="H3-REPLAY-023",
            )

    def model(self, agent: int) -> Robot | Humanoid:
        """Return the built-in model of an agent."""
        if agent not in self._models:  # to find a robot again, its files are looked at
            self._models[agent] = self._load_model(agent)
        return self._models[agent]

    def _load_model(self, agent: int) -> Robot | Humanoid:
        kind, _, name = self.recording.agents[agent].model.partition("/")
        if kind == "robot":
            with names_from_data():
                return load_robot(name)
        if kind == "humanoid":
            # without a clip that is not in the recording, the person stands
            for lost in re.findall(r"\+\w+=(motion):(\w+)", name):
                if (file := "_".join(lost) + ".npz") not in self.recording.attachments:
                    name, self.missing[file] = re.sub(rf"\+\w+={':'.join(lost)}", "", name), 1
            return load_humanoid(name)
        raise FormatError(
            f"Agent {self.recording.agents[agent].name!r} has the model {self.recording.agents[agent].model!r}; "
            "expected robot/<name> or humanoid/<name>.",
            code="H3-REPLAY-018",
        )

    # --- poses --------------------------------------------------------------------------------------------------------
    def link_matrices(self, agent: int, steps: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """Return world matrices of a robot's links, or of a person's parts, at ``steps`` (default all), shape [T, L, 4, 4].

        For a long recording the result is large, so request a few steps at a time, or one link (`link_track`).
        """
        return self._links_of(agent).at(steps, slice(None))

    def link_track(self, agent: int, link: int, steps: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """Return the world matrices of one link of a robot or part of a person at ``steps`` (default all), shape [T, 4, 4]."""
        return self._links_of(agent).at(steps, link)

    def _links_of(self, agent: int) -> LinkPoses:
        if agent not in self._links:
            model = self.model(agent)
            pose = self._robot_poses(agent, model) if isinstance(model, Robot) else self._part_poses(agent, model)
            self._links[agent] = LinkPoses(*pose)
        return self._links[agent]

    def _robot_poses(self, agent: int, robot: Robot) -> tuple[Callable[[NDArray[np.integer]], Array], int, int]:
        base, joints = self.recording.agent_column(agent, "base_pose"), self.robot_joints(agent, robot)
        return lambda steps: robot.link_matrices(base[steps], joints[steps]), len(base), len(robot.links)

    def robot_joints(self, agent: int, robot: Robot) -> NDArray[np.floating]:
        """Return joint positions of a robot at all steps for rendering, shape [T, J] [rad or m].

        Legs may trot (``stepping``).
        """
        base, joints = (self.recording.agent_column(agent, name) for name in ("base_pose", "joint_pos"))
        if self.stepping and legs_are_posed(robot, joints):
            return trot(robot, base, joints, heights=self.heights)
        return joints

    def _part_poses(self, agent: int, body: Humanoid) -> tuple[Callable[[NDArray[np.integer]], Array], int, int]:
        if self.people == "skin":
            raise InputError(
                f"Agent {self.recording.agents[agent].name!r} is a person with a skin, without links.",
                code="H3-REPLAY-024",
            )
        joints = [part.joint for part in rigid_parts(body, self.people)]
        return lambda steps: self.joint_matrices(agent, steps)[:, joints], len(self), len(joints)

    def matrices(self, index: int, steps: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """Return world matrices of a moving drawable at ``steps`` (default all), shape [T, 4, 4].

        NaN where it was absent.
        """
        rows = np.arange(len(self)) if steps is None else np.asarray(steps)
        track = self._tracks[index]
        if isinstance(track, BodyTrack):
            out = pose_to_matrix(self.recording.columns["object_pose"][rows, track.column])
            out[:, :3, :3] *= track.scale
            # an absent body is NaN in all of its matrix, also in the last row
            out[np.isnan(out[:, 0, 0])] = np.nan
            return out
        if isinstance(track, LinkTrack):
            return self.link_track(track.agent, track.link, rows)
        if isinstance(track, JointTrack):
            motions = self.joint_motions(rows)[:, track.joint]
            return (motions @ self._drawables[index].matrix).astype(np.float32)
        return np.broadcast_to(self._drawables[index].matrix.astype(np.float32), (len(rows), 4, 4))

    def joint_motions(self, steps: NDArray[np.integer]) -> Array:
        """Return the world matrices by which doors, drawers and other joints have moved at ``steps``, [T, J, 4, 4].

        Each matrix maps points from their positions in ``recording.bodies``; J = 0 in scenes without joints.
        """
        if self._joints is None:
            return np.zeros((len(steps), 0, 4, 4))
        positions = self.recording.columns[JOINTS][steps].astype(np.float64)
        # each thing that moves asks for its own step by step, and in most steps no joint has moved
        if self._moved is None or self._moved[0] != positions.tobytes():
            self._moved = positions.tobytes(), self._joints.motions(positions)
        return self._moved[1]

    def joint_matrices(self, agent: int, steps: NDArray[np.integer]) -> NDArray[np.floating]:
        """Return the world matrices of a person's 55 joints at ``steps``, shape [T, 55, 4, 4]."""
        body = self.model(agent)
        if not isinstance(body, Humanoid):
            raise InputError(
                f"Agent {self.recording.agents[agent].name!r} is not a humanoid with a skeleton.", code="H3-REPLAY-025"
            )
        prefix, columns = f"agent_{agent}.", self.recording.columns
        if prefix + "joint_quat" in columns:
            return body.joint_matrices_free(columns[prefix + "root_pose"][steps], columns[prefix + "joint_quat"][steps])
        arms = columns[prefix + "motion_arms"][steps] if prefix + "motion_arms" in columns else None
        if self.stepping:
            # feet that stand do not slide, as they do in clips alone
            tables, states = self._gait_of(agent, body)
            quats, pelvis = pose_planted(tables, states[steps])
            if arms is not None:
                draw_in(quats, arms, shoulders_forward=True)
        else:
            motion = (columns[prefix + name][steps] for name in ("motion_id", "motion_phase", "motion_blend"))
            quats, pelvis = body.clip_pose(*motion, arms=arms)
        if prefix + "motion_seat" in columns:
            take_seats(body, quats, pelvis, columns[prefix + "motion_seat"][steps])
        if self.stepping and (gestures := self._gestures_of(agent)) is not None:
            add_gestures(body, quats, pelvis, gestures[steps])
        if prefix + "motion_hands" in columns:
            lead_hands(body, quats, pelvis, columns[prefix + "motion_hands"][steps])
        for name, act in body.acts.items():
            act.replay(self.recording, agent, name, steps, quats, pelvis)
        return body.joint_matrices(columns[prefix + "base_pose"][steps], quats, pelvis)

    @cached_property
    def heights(self) -> NDArray[np.float64]:
        """Floor heights of the recorded home in the form of `h3data.scene.floor_heights`, [K, 10].

        K = 0 if the floor is level or its height unknown.
        """
        return LEVEL if self.scene is None else room_heights(self.scene.rooms)

    def _gait_of(self, agent: int, body: Humanoid) -> tuple[Any, Array]:
        """Gaits of a person in the recorded home, and the states at all steps."""
        if agent not in self._gaits:
            time_s = self.recording.columns["time_ns"].astype(np.float64) * 1e-9
            tables = body.gait_tables if self.scene is None else drawn_in(body.gait_tables, self.scene)
            self._gaits[agent] = tables, planted_states(tables, self.recording.agent_column(agent, "base_pose"), time_s)
        return self._gaits[agent]

    def _gestures_of(self, agent: int) -> Array | None:
        if agent not in self._gestures:
            self._gestures[agent] = recorded_gestures(self.recording, agent)
        return self._gestures[agent]

    def vertices(self, index: int, steps: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the world vertices of a deformable drawable at ``steps``, shape [T, V, 3] [m]; NaN where it was absent."""
        track, steps = self._tracks[index], np.asarray(steps)
        if isinstance(track, RigTrack):
            bones = pose_to_matrix(self.recording.columns[track.column][steps].astype(np.float64))
            return track.skin.vertices(self._roots(track.body, steps), bones, track.bones)
        if not isinstance(track, PersonTrack):
            raise InputError(f"{self._drawables[index].name!r} is rigid. Hint: use matrices().", code="H3-REPLAY-026")
        body = self.model(track.agent)
        assert isinstance(body, Humanoid)
        return body.skin(self.joint_matrices(track.agent, steps), lod=self.detail is False)

    def _roots(self, body: Body, steps: NDArray[np.integer]) -> Array:
        if body.moving < 0:
            return np.broadcast_to(_matrix(body), (len(steps), 4, 4))
        roots = pose_to_matrix(self.recording.columns["object_pose"][steps, body.moving].astype(np.float64))
        roots[:, :3, :3] *= body.scale
        return roots

    def row(self, step: int) -> int:
        """Return the row of ``step`` in the recording's columns; negative steps count from the end.

        Raises:
            InputError: there is no such step.
        """
        try:
            number = operator.index(step)
        except TypeError:
            raise InputError(f"Expected a step as a whole number, got {step!r}.", code="H3-REPLAY-027") from None
        if not -len(self) <= number < len(self):
            raise self._no_such_step(number)
        return number % len(self)

    def _no_such_step(self, step: int) -> InputError:
        return InputError(
            f"There is no step {step}: the recording has {len(self)} steps, 0 to {len(self) - 1}.", code="H3-REPLAY-019"
        )

    def at(self, step: int) -> State:
        """Return the state after action ``step``; negative steps count from the end."""
        step = self.row(step)
        poses = {}
        for index, drawable in enumerate(self._drawables):
            if drawable.deformable:
                continue
            matrix = self.matrices(index, np.array([step]))[0] if drawable.moving else drawable.matrix
            if np.isfinite(matrix[0, 0]):
                poses[drawable.name] = np.asarray(matrix, np.float64)
        columns = self.recording.columns
        agents = {
            agent.name: {
                name.partition(".")[2]: columns[name][step] for name in columns if name.startswith(f"agent_{i}.")
            }
            for i, agent in enumerate(self.recording.agents)
        }
        return State(step, float(columns["time_ns"][step]) * 1e-9, poses, agents)


def _recorded_joints(recording: Recording, scene: Scene | None) -> SceneJoints | None:
    """Return the joints of the home whose positions were recorded; None if there are none.

    Raises:
        FormatError: the numbers of joints in the recording and in the home differ.
    """
    if scene is None or JOINTS not in recording.columns:
        return None
    joints, shape = joints_of(scene), recording.columns[JOINTS].shape[1:]
    if shape != (len(joints),):
        raise FormatError(
            f"Expected {JOINTS} [T, {len(joints)}], one for each joint of the scene, got [T, *{shape}].",
            code="H3-REPLAY-020",
        )
    return joints


def _matrix(body: Body) -> Array:
    """Return the matrix [4, 4] from mesh to world of a body at its first pose."""
    # a body that is absent at first has no pose there
    matrix = pose_to_matrix(np.nan_to_num(body.pose.astype(np.float64)))
    matrix[:3, :3] *= body.scale
    return matrix


BEGINS, ENDS = "activity", ("activity", "walks_to", "gets_up")
"""Kinds of the events that start and end a gesture; the target of the first is the name of the activity."""
RAMP_S = 0.8
"""Time in which the hands move into the gesture at its start, and back before its end [s]."""


def recorded_gestures(recording: Recording, agent: int) -> Array | None:
    """Return the gestures of an agent at all steps, [T, 3], as `h3data.bodies.people.gestures.add_gestures` takes them.

    Gestures of seated people start when they sit, and are omitted while they do not. The result is None if the agent
    has no activity with a gesture.
    """
    turns = [event for event in recording.events if event.agent == agent and event.kind in ENDS]
    if not any(event.kind == BEGINS and event.target in NAMES for event in turns):
        return None
    seconds = recording.columns["time_ns"].astype(np.float64) * 1e-9
    seats = recording.columns.get(f"agent_{agent}.motion_seat")
    out = np.zeros((len(seconds), 3))
    for k, event in enumerate(turns):
        begin = max(event.step, 0)
        end = next((after.step for after in turns[k + 1 :] if after.step > begin), len(seconds))
        if event.kind != BEGINS or event.target not in NAMES or begin >= end:
            continue
        if GESTURES[event.target].seated:
            on_seat = np.flatnonzero(seats[begin:end, 1] >= 1) if seats is not None else np.zeros(0, np.intp)
            if not len(on_seat):
                continue
            begin += int(on_seat[0])
        rows = slice(begin, end)
        since, left = seconds[rows] - seconds[begin], seconds[end - 1] - seconds[rows]
        out[rows] = gesture_rows(event.target, agent, since, left if end < len(seconds) else np.inf)
    return out


def gesture_rows(name: str, agent: int, since: Array, left: ArrayLike) -> Array:
    """Return the rows [T, 3] of `recorded_gestures` at times ``since`` a gesture began and ``left`` until it ends [T] [s]."""
    u = np.clip(np.minimum(since, left) / RAMP_S, 0.0, 1.0)
    # 1.9: time between the gestures of agents with successive numbers, so that people who talk to each
    # other do not move alike [s]
    return np.column_stack([np.full(len(u), NAMES.index(name)), since + 1.9 * agent, smoothstep(u)])


BLOCK_STEPS = 256
"""Number of steps whose poses are computed together."""
BLOCKS_KEPT = 16


class LinkPoses:
    """World matrices of one agent's links along a recording, computed on demand by any thread."""

    def __init__(self, pose: Callable[[NDArray[np.integer]], NDArray[np.floating]], steps: int, links: int) -> None:
        """Compute poses by the function ``pose``, which returns the matrices [t, L, 4, 4] at steps [t]."""
        self._pose, self._steps, self._links = pose, steps, links
        # threads render neighbouring steps, which lie in few blocks
        self._block = lru_cache(maxsize=BLOCKS_KEPT)(self._pose_block)

    def at(self, steps: NDArray[np.integer] | None, link: int | slice) -> NDArray[np.float32]:
        """Return world matrices at ``steps`` (default all) of one link, [T, 4, 4], or of a slice of links, [T, L, 4, 4]."""
        rows = np.arange(self._steps) if steps is None else np.arange(self._steps)[steps]
        blocks = rows // BLOCK_STEPS
        numbers = np.unique(blocks)
        if len(numbers) == 1:
            return self._block(int(numbers[0]))[rows % BLOCK_STEPS, link]
        out = np.empty((len(rows), *np.empty(self._links)[link].shape, 4, 4), np.float32)
        for number in numbers:
            chosen = blocks == number
            out[chosen] = self._block(int(number))[rows[chosen] % BLOCK_STEPS, link]
        return out

    def _pose_block(self, number: int) -> NDArray[np.float32]:
        rows = np.arange(number * BLOCK_STEPS, min((number + 1) * BLOCK_STEPS, self._steps))
        return self._pose(rows).astype(np.float32)
