"""One idea: a task with things in one file. The robot brings two things to their places and opens a drawer for the person.

python examples/fetch.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.errors import SceneError
from h3data.policies import Action, RearrangeView, resolve_policy
from h3data.tasks import (
    Control,
    Rearrange,
    RearrangeCodec,
    RearrangeSpec,
    SkillControl,
    StepOutcome,
    TaskUsage,
    WorldRollout,
    generator,
    with_oracle_skills,
)


@dataclass(frozen=True, kw_only=True, repr=False)
class FetchSpec(RearrangeSpec):
    """Rules in addition to those of every task with things."""

    parts: int = 1
    """Number of drawers to open, one, which agents may choose by number."""
    drawer_worth: float = 5.0
    """Reward for opening the drawer."""
    thing_worth: float = 10.0
    """Reward for each thing that comes to its goal."""


def drawer_of(episode: Any) -> int:
    """Return the number of the drawer to open, among all that opens in the home; it follows from the seed.

    Raises:
        SceneError: the home has no drawers.
    """
    parts = [part for thing in episode.scene.articulations for part in thing.parts]
    drawers = [k for k, part in enumerate(parts) if part.joint.kind == "prismatic"]
    if not drawers:
        raise SceneError(
            f"Fetch needs a home with drawers, {episode.scene.name!r} has none. Hint: HomeSpec(articulated=True)."
        )
    return int(generator(episode.seed, "drawer").choice(drawers))


class DrawerFirst:
    """Policy for skills, which goes to the drawer and opens it, and then follows another policy."""

    def __init__(self, drawer: int, then: Any) -> None:
        self.drawer, self.then = drawer, then
        self.failures, self.over = 0, False

    def act(self, view: RearrangeView) -> Action:
        """Return the next skill; the method is called when the last one has ended."""
        ended = None if view.action is None or view.last is None else (view.action.skill, view.last.outcome)
        if not self.over and ended is not None:
            self.failures += ended[1] == "failed"
            self.over = ended == ("open", "done") or self.failures == 3
        if self.over:
            return self.then.act(view)
        return Action("open" if ended == ("nav_to_handle", "done") else "nav_to_handle", self.drawer)

    def interrupts(self, view: RearrangeView) -> str:
        """Return the reason for aborting the running skill; empty if it continues."""
        return self.then.interrupts(view) if self.over else ""


def drawer_first(task: Any, episode: Any, number: int) -> DrawerFirst:
    """Return the policy for one episode, in which the robot then brings the things that the person does not bring."""
    return DrawerFirst(drawer_of(episode), resolve_policy(task, "robot", "complement")(episode, number).policy)


class FetchCodec(RearrangeCodec):
    """Codec of the task's episodes, which differs from that of rearrangement only in its instruction."""

    def drawer_name(self, episode: Any) -> str:
        """Return the name of the drawer to open, ``thing/part``."""
        names = [f"{thing.name}/{part.name}" for thing in episode.scene.articulations for part in thing.parts]
        return names[drawer_of(episode)]

    def instruction(self, episode: Any) -> str:
        """Return the instruction for the task as one sentence."""
        words = self.drawer_name(episode).replace("_", " ").replace("/", " ")
        return f"open {words} and {super().instruction(episode)}"


class Fetch(Rearrange):
    """Task of opening the drawer and bringing each thing to its goal.

    Contact with the person costs reward and ends the episode.
    """

    name = "fetch"
    Spec = FetchSpec
    control: ClassVar[Control] = SkillControl()
    columns: ClassVar[Mapping[str, Any]] = {"metrics.at_goal": np.bool_, "metrics.drawer_open": np.bool_}
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        **Rearrange.policies,
        "robot": {"drawer_first": drawer_first},
    }
    defaults: ClassVar[Mapping[str, str]] = {"robot": "drawer_first", "human": "object_1"}
    usage = TaskUsage(device_rules=with_oracle_skills(FetchSpec()))

    @property
    def codec(self) -> FetchCodec:
        """Codec that writes episodes of the task to files."""
        return FetchCodec(self)

    def sample(self, scene: Any, free: Any, seed: int, spec: Any, roster: Any) -> Any:
        """Sample things, goals and starts that both bodies can reach, in a home with a drawer."""
        episode = super().sample(scene, free, seed, spec, roster)
        drawer_of(episode)
        return episode

    def parts_of(self, episode: Any) -> tuple[int, ...]:
        """Return the drawer to open."""
        return (drawer_of(episode),)

    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> Mapping[str, Any]:
        """Reset the rewards that have been given: for the drawer, then for each thing.

        On a device these are tensors, as in ``judge``.
        """
        none = play.xp.concatenate([play.open_parts, play.at_goal], -1)
        return {"paid": none & ~none}

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Reward once the open drawer and each thing that lies at its goal, in no hand."""
        there = play.xp.concatenate([play.open_parts, play.at_goal], -1)
        fresh, play.memory["paid"] = there & ~play.memory["paid"], there | play.memory["paid"]
        success, collides = there.all(-1), play.world.touching.any(-1)
        paid = play.spec.drawer_worth * fresh[:, 0] + play.spec.thing_worth * fresh[:, 1:].sum(-1)
        return StepOutcome(
            reward=paid - 1.0 * collides,
            terminated=success | collides,
            success=success,
            columns={"metrics.at_goal": play.at_goal, "metrics.drawer_open": there[:, 0]},
            events=play.events_where(fresh[:, 0], "opened"),
        )


if __name__ == "__main__":
    home = h3data.build_home(h3data.HomeSpec(seed=2, articulated=True))
    recording = h3data.simulate(Fetch(), scenes=home, seed=3)
    print(recording.episode.info["instruction"])
    for span in recording.skills:
        print(f"step {span.start_step:4d}  agent {span.agent}  {span.name} {span.target}: {span.outcome} {span.reason}")
    reward = recording.columns["metrics.reward"].sum()
    print(f"{recording.episode.info['ended']} after {len(recording)} steps, reward {reward:.0f}")
    env = h3data.make(Fetch(), scenes=home)
    env.reset(seed=0)
    print("an environment step lasts until the robot must choose again:", env.step(0)[4]["steps"], "steps of 1/30 s")
