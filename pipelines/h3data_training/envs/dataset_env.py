"""Environments with the observations of demonstrations exported to LeRobot, which need the extra ``env``."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.gestures import lead_hands
from h3data.bodies.people.planted_gait import PlantedWalk, drawn_in, pose_planted
from h3data.bodies.people.sitting import take_seats
from h3data.errors import InputError, suggest
from h3data.plugins import names_from_data
from h3data.recording import Dataset, Recording, write_mcap
from h3data.recording.demonstrations import Demonstrations, read_demonstrations
from h3data.render.light.sources import LightMode, check_light
from sim_kinematic.contact.frames import body_frames
from sim_kinematic.envs.single import checked_render_mode, run_seed
from sim_kinematic.envs.stepper import checked_actions, gymnasium, refuse_tensors
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.assignment import assign
from sim_kinematic.policies.policy import External, Velocity
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer
from sim_kinematic.sensing.eyes import shared_renderer
from sim_kinematic.sensing.watching import DebugRenderer
from sim_kinematic.tasks.episode import MAX_STEPS, Episode
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.recorder import Recorder
from sim_kinematic.tasks.resimulation import scene_and_map
from sim_kinematic.tasks.resume import task_of
from sim_kinematic.tasks.sources import EpisodeSource, Scenes

if TYPE_CHECKING:
    from gymnasium.spaces import Dict

EpisodeChoice = Literal["sampled", "recorded"]


class DatasetEnv(gymnasium.Env[Any, Any]):
    """Environment of one world for a policy that was trained on a dataset.

    Observations have the keys of the dataset, `observation.state` and `observation.images.CAMERA`, and the same
    cameras. Rewards are those of the dataset too: 1 for the step that first leads to success. ``info["is_success"]``
    states whether the episode has been successful so far.

    As in the dataset, the first observation is that after the first step of the episode. In this step, the agent
    repeats its recorded action in recorded episodes, and stands still in sampled ones.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_S)}  # type: ignore[misc]

    def __init__(
        self,
        dataset: str | os.PathLike[str],
        scenes: Scenes | None = None,
        *,
        episodes: EpisodeChoice = "sampled",
        cameras: Sequence[str] | None = None,
        max_steps: int | None = None,
        light: LightMode | None = None,
        render_mode: str | None = None,
        record: str | os.PathLike[str] | None = None,
    ) -> None:
        """Read a dataset that ``h3data export --to lerobot`` wrote.

        Args:
            dataset: folder of the dataset.
            scenes: homes of sampled episodes, as for `h3data.make` (default: those of the dataset).
            episodes: ``sampled``: new episodes under the rules of the dataset's first episode. ``recorded``: the
                dataset's own, from their starts; ``reset(seed=k)`` starts episode k.
            cameras: names of the cameras to observe, as in ``robot_arm`` (default: all that the dataset has).
            max_steps: length limit of an episode (default: that of its rules).
            light: light of the pictures (default: that of the videos).
            render_mode: ``rgb_array`` for `render`, or None.
            record: folder for the recording of each episode that is played to its end, ``SEED-NUMBER.mcap`` (default: none).

        Raises:
            InputError: the dataset was not exported to LeRobot, or it cannot be played, because its task has skills,
                its agent is not a robot, or one of its cameras is not on an agent.
            FormatError: the dataset is damaged.
        """
        given = {"episodes": episodes, "cameras": cameras, "max_steps": max_steps, "light": light}
        folder = None if record is None else str(record)
        self._arguments = (str(dataset), scenes, {**given, "render_mode": render_mode, "record": folder})
        if episodes not in get_args(EpisodeChoice):
            raise InputError(
                f"Expected episodes {' or '.join(get_args(EpisodeChoice))}, got {episodes!r}.", code="H3-ENV-043"
            )
        if max_steps is not None and not 2 <= max_steps <= MAX_STEPS:
            raise InputError(f"Expected max_steps from 2 to {MAX_STEPS}, got {max_steps}.", code="H3-ENV-044")
        if scenes is not None and episodes == "recorded":
            raise InputError(
                "Recorded episodes play in their own homes. Hint: leave out scenes, or sample episodes.",
                code="H3-ENV-045",
            )
        self.render_mode = checked_render_mode(render_mode)
        self.dataset = Dataset(dataset)
        self.demonstrations = _playable(read_demonstrations(self.dataset.root), len(self.dataset))
        check_light(light or self.demonstrations.light)
        self.light: LightMode = light or self.demonstrations.light  # type: ignore[assignment]
        self._recorded, self._max_steps, self._scenes = episodes == "recorded", max_steps, scenes
        first = self.dataset[0]
        self._task, self.task = task_of(first), self.demonstrations.task
        if self._task.control.has_skills:
            raise InputError(
                f"Recordings of {self._task.name} hold the velocity of the base, and not what the arm did: a policy that has "
                f"learned from them cannot play. Expected demonstrations of a task whose agents only drive and walk.",
                code="H3-ENV-046",
            )
        self._number = [agent.name for agent in first.agents].index(self.demonstrations.agent)
        self._cameras = _shown(self.demonstrations, cameras, first)
        self._first, self._watcher = self._restored(first), DebugRenderer()
        self._source: EpisodeSource | None = None
        self._seed, self._index = 0, -1
        self.play: WorldRollout | None = None
        self.record = None if folder is None else Path(folder)
        """Folder of recordings; changes count from the next `reset`."""
        self._recorder: Recorder | None = None
        self._loop: DecisionLoop | None = None
        self._succeeded = False
        self._columns: dict[str, NDArray[Any]] = {}
        """Columns of the step that has just been made, as a recording has them, one row each."""
        self._walks: dict[int, PlantedWalk] = {}
        """Feet of each person, by number of the agent."""
        self.task_description = self._task.codec.instruction(self._first)
        """Task in words, in the form with which language-conditioned policies were trained."""
        width = len(self.demonstrations.action_names)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (width,), np.float32)
        self.observation_space = self._space()

    @property
    def max_episode_steps(self) -> int:
        """Largest number of steps of an episode, without the step that `reset` makes."""
        return (self._max_steps or self._first.spec.max_steps) - 1

    def _space(self) -> Dict:
        shown = self.demonstrations
        state = gymnasium.spaces.Box(-np.inf, np.inf, (len(shown.state_names),), np.float32)
        pictures = {
            camera.key: gymnasium.spaces.Box(0, 255, (camera.stored_height, camera.stored_width, 3), np.uint8)
            for camera, _ in self._cameras
        }
        return gymnasium.spaces.Dict({shown.state_key: state, **pictures})

    # --- episodes -----------------------------------------------------------------------------------------------------
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start the next episode, or with ``seed`` the first episode of another run or the recorded one of that number.

        Raises:
            SceneError: no episode can be sampled in a scene.
        """
        super().reset(seed=seed)
        if seed is not None or self._index < 0:
            self._seed = (seed or 0) if self._recorded else run_seed(seed, self.np_random)
            self._index = -1
        self._index += 1
        begun = np.zeros(self.action_space.shape or (), np.float32)
        facts: dict[str, Any] = {}
        if self._recorded:
            number = (self._seed + self._index) % len(self.dataset)
            recording = self.dataset[number]
            episode = self._restored(recording)
            begun = recording.columns[f"agent_{self._number}.action"][0]
            facts["episode_index"] = number
        else:
            episode = self._sampled()
        if self._max_steps is not None:
            episode = replace(episode, spec=replace(episode.spec, max_steps=self._max_steps))
        self._begin(episode)
        self._succeeded = False
        self._walks = {}
        self._advance(begun)
        facts |= {"scene": episode.scene.name, "episode_seed": episode.seed}
        return self._observed(), {**self._informed(), **facts}

    def _restored(self, recording: Recording) -> Episode:
        file = recording.attachments["scene.glb"]
        with names_from_data():
            return self._task.codec.restore(recording, lambda radius, height: scene_and_map(file, radius, height))

    def _sampled(self) -> Episode:
        if self._source is None:
            first, shown = self._first, self.demonstrations
            homes = [self._restored(self.dataset[scene.episode]).scene for scene in shown.scenes]
            agents = [f"{member.kind}:{member.model}" for member in first.roster]
            scenes = homes if self._scenes is None else self._scenes
            self._source = EpisodeSource(self._task, scenes, spec=first.spec, agents=agents)
        self._source.prepare([(self._seed, self._index)])
        return self._source.sample(self._seed, self._index)

    def _begin(self, episode: Episode) -> None:
        shown = self.demonstrations
        others = {who.name: who.policy for who in shown.agents if who.name != shown.agent and who.policy}
        with names_from_data():
            policies = assign(self._task, episode, {**others, shown.agent: External()})
        play = WorldRollout.of(self._task, episode, policies, measure=False)
        self.play, self._loop = play, DecisionLoop(play)
        self._recorder = None
        if self.record is not None:
            name = f"{self._seed}-{self._index}"
            self._recorder = Recorder.of(play, episode_id=name)

    def step(self, action: ArrayLike) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Apply an action for 1/30 s.

        Raises:
            InputError: the action is a torch tensor, has the wrong shape or is not finite, or no episode is running.
        """
        refuse_tensors(action, self.task, self.demonstrations.agent)
        checked = checked_actions(action, self.action_space.shape or ())
        if self._loop is None or self._loop.over or self.play is None or self.play.over:
            raise InputError("No episode is going on. Hint: call reset() first.", code="H3-ENV-027")
        self._loop.go_on()
        reward = self._advance(np.asarray(checked, np.float32))
        over = self.play.over
        timed_out = over and self.play.ended == "max_steps"
        return self._observed(), reward, over and not timed_out, timed_out, self._informed()

    def _advance(self, action: NDArray[Any]) -> float:
        """Make one step, and return its reward."""
        play, loop = self.play, self._loop
        assert play is not None
        assert loop is not None
        choice = Velocity(float(action[0]), float(action[1]))
        while loop.asked is not None:
            own = loop.asked == self._number
            loop.answer(choice if own else play.policies[loop.asked].policy.act(play.view(loop.asked)))
        happened = any(event.kind in self.demonstrations.success_events for event in play.events)
        happened = happened or (play.over and play.ended == "success")
        if self._recorder is None:
            play.events.clear()
            self._columns = play.columns([play.snapshot()], play.step - 1)
        else:
            self._recorder.add()
            self._columns = self._recorder.latest_columns()
            self._keep(self._recorder)
        if self._cameras or self.render_mode:
            self._walk(play)
        first, self._succeeded = happened and not self._succeeded, self._succeeded or happened
        return float(first)

    def _keep(self, recorder: Recorder) -> None:
        """Write the recording of an episode that has just ended."""
        play = recorder.play
        if play.over and self.record is not None:
            self.record.mkdir(parents=True, exist_ok=True)
            recording = recorder.finish(self._task.codec.final_info(play.episode, play, play.policies))
            write_mcap(recording, self.record / f"{recording.episode.episode_id}.mcap", overwrite=True)

    # --- what is shown ------------------------------------------------------------------------------------------------
    def _observed(self) -> dict[str, NDArray[Any]]:
        shown, columns = self.demonstrations, self._columns
        state = np.concatenate([columns[name].reshape(-1).astype(np.float32) for name in shown.state_columns])
        seen: dict[str, NDArray[Any]] = {shown.state_key: state}
        if not self._cameras:
            return seen
        drawn = self._posed()
        for camera, number in self._cameras:
            size = (camera.width, camera.height)
            sensor = CameraSensor(camera=camera.camera, agent=number, outputs=("rgb",), size=size)
            picture = sensor.observe(drawn)["rgb"][0]
            more = (0, camera.stored_height - camera.height), (0, camera.stored_width - camera.width), (0, 0)
            seen[camera.key] = np.pad(picture, more, mode="edge")
        return seen

    def _informed(self) -> dict[str, Any]:
        return {"is_success": self._succeeded}

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return a picture of the agent and its surroundings from obliquely above, uint8 [480, 640, 3].

        It is None without a render mode.
        """
        if self.render_mode is None:
            return None
        if self.play is None:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        return self._watcher.picture(self._posed(), self._number)

    def _posed(self) -> StateRenderer:
        """Return the renderer of the home, with everybody posed as replays of recordings pose them.

        People set their feet along the track of the whole episode so far. Clips, as other environments show them, would put
        arms and legs elsewhere than the videos have them.
        """
        assert self.play is not None
        world, scene, speed = self.play.world, self.play.episode.scene, self.play.spec.human.speed_mps
        bodies = tuple(member.body for member in world.roster)
        drawn = shared_renderer(scene, bodies, (), speed, self.light, None, threading.get_ident())
        frames = [
            self._joint_frames(k, body)
            if isinstance(body, Humanoid)
            else body_frames(body, world.state.agents[k], world.floors[0])
            for k, body in enumerate(bodies)
        ]
        drawn.pose(world.state, floor=world.floors[0], frames=frames)
        return drawn

    def _walk(self, play: WorldRollout) -> None:
        """Let people set their feet where the step that has just been made took them."""
        for k, member in enumerate(play.world.roster):
            if not isinstance(member.body, Humanoid):
                continue
            base = self._columns[f"agent_{k}.base_pose"][0]
            if k in self._walks:
                self._walks[k].step(base)
            else:
                self._walks[k] = PlantedWalk(drawn_in(member.body.gait_tables, play.episode.scene), base)

    def _joint_frames(self, number: int, body: Humanoid) -> NDArray[np.floating]:
        """Return the world frames of a person's joints now, [1, 55, 4, 4]."""
        agent, now = f"agent_{number}.", self._columns
        quats, pelvis = pose_planted(self._walks[number].tables, self._walks[number].state[None])
        if agent + "motion_arms" in now:
            draw_in(quats, now[agent + "motion_arms"], shoulders_forward=True)
        if agent + "motion_seat" in now:
            take_seats(body, quats, pelvis, now[agent + "motion_seat"])
        if agent + "motion_hands" in now:
            lead_hands(body, quats, pelvis, now[agent + "motion_hands"])
        return body.joint_matrices(now[agent + "base_pose"], quats, pelvis)

    def __reduce__(self) -> tuple[Callable[[], DatasetEnv], tuple[()]]:
        dataset, scenes, options = self._arguments
        return partial(type(self), dataset, scenes, **options), ()

    def __repr__(self) -> str:
        kind = "recorded" if self._recorded else "sampled"
        shown = (self.demonstrations.state_key, *(camera.key for camera, _ in self._cameras))
        return f"{type(self).__name__}({self.task}, {kind} episodes, {', '.join(shown)})"

    __str__ = __repr__


def _playable(shown: Demonstrations, episodes: int) -> Demonstrations:
    """Return the demonstrations of a robot that has some episodes."""
    if not episodes or len(shown.seeds) != episodes:
        raise InputError(
            f"Expected meta/h3data.json to describe the dataset's {episodes} episodes, it describes {len(shown.seeds)}. Hint: "
            "export it again with h3data export --to lerobot.",
            code="H3-ENV-048",
        )
    kinds = {agent.name: agent.kind for agent in shown.agents}
    if kinds.get(shown.agent) != "robot":
        raise InputError(
            f"Expected demonstrations of a robot, those of {shown.agent!r} are of a {kinds.get(shown.agent, 'stranger')}.",
            code="H3-ENV-042",
        )
    return shown


def _shown(shown: Demonstrations, names: Sequence[str] | None, first: Recording) -> list[tuple[Any, int]]:
    """Return the cameras to show, each with the number of the agent that carries it."""
    known = {camera.key.removeprefix("observation.images."): camera for camera in shown.cameras}
    agents = {agent.name: number for number, agent in enumerate(first.agents)}
    chosen = list(known) if names is None else list(names)
    for name in chosen:
        if name not in known:
            raise InputError(
                f"The dataset has no camera {name!r}.{suggest(name, known, lead='It has')}", code="H3-ENV-047"
            )
        if known[name].agent not in agents:
            carried = ", ".join(other for other in known if known[other].agent in agents) or "none"
            raise InputError(
                f"Nobody carries the camera {name!r}, so that an environment cannot show what it showed. Hint: cameras= with "
                f"those on which the policy was trained: {carried}.",
                code="H3-ENV-049",
            )
    return [(known[name], agents[known[name].agent]) for name in dict.fromkeys(chosen)]
