"""Social rearrangement, simulated: a robot helps a person to bring objects to their goals (paper section 4.2 and appendix;
spec/habitat.md 2).

Two layers: high-level policies (`sim_kinematic.planners`) choose skills (`sim_kinematic.skills`), skills move bodies.
"""

from __future__ import annotations

from collections.abc import Callable

from h3data.recording import Recording, RecordingHeader
from sim_kinematic.learned import stamped
from sim_kinematic.planners import HighLevelPolicy, partner_plan, partner_policy, planner, robot_policy
from sim_kinematic.rearrange_episode import RearrangeWorld
from sim_kinematic.rearrange_log import SOLO, RearrangeLog, describe, finished
from sim_kinematic.rearrange_play import RearrangePlay
from sim_kinematic.social_nav_log import Sink


def simulate_rearrange(
    world: RearrangeWorld,
    *,
    policy: str | HighLevelPolicy = "complement",
    partner: str | HighLevelPolicy = "both",
    episode_id: str = "0",
    solo_steps: int | None = None,
    sink: Callable[[RecordingHeader], Sink] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Recording:
    """Run one episode to its end and return its recording.

    ``policy`` moves the robot (a name in `ROBOT_POLICIES`; ``solo``: there is no robot), ``partner`` the person (a name in
    `PARTNERS`); either may be ``weights:FILE``, a learned one. ``solo_steps`` is what the person alone needs, by which RE is
    measured; None finds out (`solo_steps_of`). ``sink`` and ``progress`` as of `simulate_social_nav`.

    Raises:
        InputError: no such policy or partner.
    """
    plan = partner_plan(partner, world.seed) if isinstance(partner, str) else ""
    objects = len(world.targets)
    robot = None if policy == SOLO else robot_policy(policy, objects) if isinstance(policy, str) else policy
    person = partner_policy(partner, world.seed, objects) if isinstance(partner, str) else partner
    header = describe(world, episode_id=episode_id, policy=_name(policy), partner=_name(partner), plan=plan)
    log = RearrangeLog(sink(header) if sink is not None else None)
    try:
        play = RearrangePlay(world, robot, person, log)
        ended = play.run(progress)
        log.columns()
        if solo_steps is None:
            alone = policy == SOLO and plan == "both"
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
    """``L_human``: the steps in which the person alone brings all objects to their goals, at most ``max_steps``."""
    play = RearrangePlay(world, None, planner("both", world.seed, len(world.targets)))
    play.run()
    return play.step + 1


def _name(policy: str | HighLevelPolicy) -> str:
    return stamped(policy) if isinstance(policy, str) else type(policy).__name__
