"""Settings of habitat-lab's social navigation measures, under its own names."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class StatsConfig:
    """Settings of habitat-lab's ``SocialNavStats``."""

    min_dis_human: float = 1.0
    max_dis_human: float = 2.0
    """Geodesic distances within which the person counts as found [m], both inclusive."""
    robot_face_human_threshold: float = 0.5
    # a constant in Habitat's code, also for tasks of 750 steps (spec/habitat.md 1.6)
    total_steps: int = 1500
    dis_threshold_for_backup_yield: float = 1.5
    """Distance (L2) within which moving back counts as yielding [m], inclusive."""
    min_abs_vel_for_yield: float = 1.0
    """Smallest speed that counts as yielding, in Habitat's units: 1 is 1/120 m per step, 0.25 m/s."""


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Settings of habitat-lab's ``SocialNavReward``; -1 switches a part off."""

    safe_dis_min: float = 1.0
    safe_dis_max: float = 2.0
    safe_dis_reward: float = 2.0
    facing_human_dis: float = 3.0
    # 0.01 in Habitat's yaml; this is the README's and the paper's (spec/habitat.md 1.1)
    facing_human_reward: float = 3.0
    toward_human_reward: float = 1.0
    near_human_bonus: float = -1.0
    explore_reward: float = -1.0
    use_geo_distance: bool = True
    count_coll_pen: float = 0.01
    max_count_colls: int = -1
    count_coll_end_pen: float = 5.0
    collide_penalty: float = 1.0


@dataclass(frozen=True, kw_only=True)
class SuccessConfig:
    """Settings of habitat-lab's ``SocialNavSeekSuccess`` measure."""

    # 500 in Habitat's yaml; this is the README's and the paper's (spec/habitat.md 1.1)
    following_step_succ_threshold: int = 400
    safe_dis_min: float = 1.0
    safe_dis_max: float = 2.0
    need_to_face_human: bool = True
    use_geo_distance: bool = True
    facing_threshold: float = 0.5
    must_look_at_targ: bool = False
    success_angle_dist: float = 0.261799


@dataclass(frozen=True, kw_only=True)
class HabitatConfig:
    """Settings of all social navigation measures.

    The defaults are those of the command in habitat-baselines' README that reproduces the paper.
    """

    stats: StatsConfig = field(default_factory=StatsConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    success: SuccessConfig = field(default_factory=SuccessConfig)
    # -0.01 in Habitat's yaml; this is the README's and the paper's (spec/habitat.md 1.1)
    slack_reward: float = -0.1
    success_reward: float = 10.0
