"""Social rearrangement, simulated: a robot helps a person to bring objects to their goals (paper section 4.2 and appendix;
spec/habitat.md 2), or any other agents do.

Two layers: high-level policies (`sim_kinematic.policies.rearrange`) choose skills (`sim_kinematic.agents.skills`), skills move bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from h3data.errors import InputError
from h3data.recording import Recording, RecordingHeader
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.policies.learned import stamped
from sim_kinematic.policies.rearrange import (
    PARTNERS,
    ROBOT_POLICIES,
    HighLevelPolicy,
    partner_plan,
    partner_policy,
    planner,
    robot_policy,
)
from sim_kinematic.tasks.rearrange.episode import RearrangeWorld
from sim_kinematic.tasks.rearrange.log import SOLO, RearrangeLog, describe, finished
from sim_kinematic.tasks.rearrange.play import RearrangePlay
from sim_kinematic.tasks.social_nav_log import Sink

Choice = str | HighLevelPolicy | Sequence[str | HighLevelPolicy]
"""Names or policies, of all agents of a kind or of each."""


def simulate_rearrange(
    world: RearrangeWorld,
    *,
    policy: Choice = "complement",
    partner: Choice = "both",
    episode_id: str = "0",
    solo_steps: int | None = None,
    sink: Callable[[RecordingHeader], Sink] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Recording:
    """Run one episode to its end and return its recording.

    ``policy`` moves the robots (a name in `ROBOT_POLICIES`; ``solo``: they are not there), ``partner`` the people (a name in
    `PARTNERS`); either may be of the other kind, or ``weights:FILE``, a learned one. Where there are several of a kind, one
    name is for all, or there is one for each: a sequence, or names with commas between. ``solo_steps`` is what one agent
    alone needs, by which RE is measured; None finds out (`solo_steps_of`). ``sink`` and ``progress`` as of
    `simulate_social_nav`.

    Raises:
        InputError: no such policy or partner, or not one for each agent.
    """
    if policy == SOLO and "human" in kinds_of(world.cast):
        world = world.only(*(k for k, kind in enumerate(kinds_of(world.cast)) if kind == "human"))
    minds = minds_of(kinds_of(world.cast), policy, partner, seed=world.seed, objects=len(world.targets))
    header = describe(world, episode_id=episode_id, policies=[m.name for m in minds], plans=[m.plan for m in minds])
    log = RearrangeLog(sink(header) if sink is not None else None)
    try:
        play = RearrangePlay(world, [mind.policy for mind in minds], log)
        ended = play.run(progress)
        log.columns()
        if solo_steps is None:
            alone = [mind.plan for mind in minds] == ["both"]
            solo_steps = play.step + 1 if alone else solo_steps_of(world)
        info = {"ended": ended, "solo_steps": solo_steps}
        recording = finished(header, log, info)
        if log.sink is not None:
            log.sink.close(info=info)
    except BaseException:
        if log.sink is not None:
            log.sink.abort()
        raise
    return recording


def solo_steps_of(world: RearrangeWorld) -> int:
    """``L_human``: the steps in which the first person alone brings all objects to their goals, at most ``max_steps``; the
    first robot, where there are no people."""
    kinds = kinds_of(world.cast)
    alone = world.only(kinds.index("human") if "human" in kinds else 0)
    play = RearrangePlay(alone, [planner("both", world.seed, len(world.targets))])
    play.run()
    return play.step + 1


class Mind(NamedTuple):
    """What moves one agent."""

    policy: HighLevelPolicy
    name: str
    """As recorded."""
    plan: str
    """Of who follows one, else empty."""


def minds_of(kinds: Sequence[str], policy: Choice, partner: Choice, *, seed: int, objects: int = 2) -> list[Mind]:
    """A fresh mind for each agent of these kinds (`sim_kinematic.agents.roster.kinds_of`) in the episode with this seed; arguments
    as of `simulate_rearrange`.

    Raises:
        InputError: no such policy or partner, or not one for each agent.
    """
    robots, people = kinds.count("robot"), kinds.count("human")
    chosen = [*_each(policy, robots, "policy", "robot"), *_each(partner, people, "partner", "person")]
    minds = []
    for k, (kind, one) in enumerate(zip(kinds, chosen, strict=True)):
        if not isinstance(one, str):
            minds.append(Mind(one, type(one).__name__, ""))
            continue
        nth = k if kind == "robot" else k - robots
        own = seed if not nth else episode_seed(seed, nth)
        follows = one in PARTNERS if kind == "robot" else one not in ROBOT_POLICIES or one in PARTNERS
        if follows and not (kind == "robot" and one in ROBOT_POLICIES):
            minds.append(Mind(partner_policy(one, own, objects), stamped(one), partner_plan(one, own)))
        else:
            minds.append(Mind(robot_policy(one, objects), stamped(one), ""))
    return minds


def _each(chosen: Choice, count: int, what: str, whose: str) -> list[str | HighLevelPolicy]:
    """One choice for each of ``count`` agents."""
    listed: list[str | HighLevelPolicy] = (
        list(chosen.split(","))
        if isinstance(chosen, str)
        else list(chosen)
        if isinstance(chosen, Sequence)
        else [chosen]
    )
    if len(listed) == 1 and isinstance(listed[0], str):
        listed *= max(count, 1)
    if count and len(listed) != count:
        raise InputError(
            f"Expected one {what} for each {whose}, {count} in all, or one name for all; got {len(listed)}."
        )
    return listed[:count]
