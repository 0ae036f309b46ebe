"""Task in which any number of robots and people move about a home from one random point to another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording import Event, Recording
from h3data.recording.assets.scenes import scene_attachment
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import AgentSpec, common_floor
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.tasks.codec import TaskCodec, uid_of
from sim_kinematic.tasks.episode import Episode, StepOutcome, rules_dict, sample_starts
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.task import Task, TaskUsage

STEPS = 300
"""Default length of an episode in a dataset [steps]."""


class WanderCodec(TaskCodec):
    """Codec that writes the names of all agents' policies as one list."""

    records_judgement: ClassVar[bool] = False

    def instruction(self, episode: Episode) -> str:
        """Return the instruction in words, the same for all episodes."""
        return "walk about the home"

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the rules, the starts and the policies that are not the default, for a recording's info."""
        info: dict[str, Any] = {
            "max_steps": episode.spec.max_steps,
            "spec": rules_dict(episode.spec),
            "starts": episode.starts.tolist(),
        }
        others = [policy.name for policy in policies]
        if set(others) != {"wander"}:
            info["policies"] = others
        return info

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return an identifier derived from scene, bodies, seed, rules, and the policies that are not the default."""
        digest = scene_attachment(episode.scene)[1]
        models = ",".join(member.model for member in episode.roster)
        what = f"wander:{digest}:{models}:{episode.seed}:{episode.spec.max_steps}:{episode.spec}"
        others = [policy.name for policy in policies]
        what += "" if set(others) == {"wander"} else f":{','.join(others)}"
        return uid_of(what)

    def policy_names(self, recording: Recording) -> list[str]:
        """Return the name of each agent's policy, which is ``wander`` if the recording has none."""
        return [str(name) for name in recording.episode.info.get("policies", ["wander"] * len(recording.agents))]

    def check_changes(self, recording: Recording, chosen: Mapping[str, Any]) -> None:
        """Raise an `InputError` if a policy is chosen, which this task does not support."""
        if chosen:
            what = "policy" if "robot" in chosen else "partner"
            raise InputError(
                f"Nobody in recordings of wander follows a {what}. Hint: leave it out.", code="H3-TASK-067"
            )


class Wander(Task):
    """Task in which all agents move to random points and give way to each other for ``max_steps`` steps."""

    name: ClassVar[str] = "wander"
    Spec: ClassVar[type[Any]] = SocialNavSpec
    defaults: ClassVar[Mapping[str, str]] = {"robot": "wander", "human": "wander"}
    usage: ClassVar[TaskUsage] = TaskUsage(
        dataset_rules=SocialNavSpec(max_steps=STEPS), named_kinds=(), bodies_in_agents=True
    )

    @property
    def codec(self) -> WanderCodec:
        """Codec of episodes whose recordings have the names of all policies in one list."""
        return WanderCodec(self)

    def sample(self, scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: tuple[AgentSpec, ...]) -> Episode:
        """Sample random starts from this task's own random stream."""
        free = common_floor(roster, free)
        # the stream keeps this name, as under another one every seed would give other starts
        starts = sample_starts(scene, free, seed, spec, roster, "agent_worlds")
        return Episode(scene=scene, free=free, seed=seed, spec=spec, roster=roster, starts=starts)

    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> None:
        """Reset all contacts, so that agents that touch at the start cause an event."""
        # pairs of agents that touched one step ago
        play.memory = np.zeros_like(play.world.touching)

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Report each new contact between two agents as an event; rewards are 0, and no rule ends the episode."""
        world = play.world
        events = [
            # the step is counted before it is judged, and events number steps from 0
            (int(w), Event(step=int(play.steps[w]) - 1, agent=a, kind="collision", target=world.roster[b].name))
            for w, p in zip(*np.nonzero(world.touching & ~play.memory), strict=True)
            for a, b in [world.pairs[p]]
        ]
        play.memory = world.touching.copy()
        nothing = np.zeros(world.worlds, np.bool_)
        return StepOutcome(reward=np.zeros(world.worlds), terminated=nothing, success=nothing, events=events)
