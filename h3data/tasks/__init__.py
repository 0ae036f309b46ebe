"""Base classes for custom tasks (h3data docs extending)."""

from __future__ import annotations

from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import BaseSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.tasks.codec import EpisodeCodec, TaskCodec
from sim_kinematic.tasks.control import Control, VelocityControl
from sim_kinematic.tasks.episode import Episode, StepOutcome, TaskSpec, sample_starts
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.codec import RearrangeCodec
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec, with_oracle_skills
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.sessions import Session
from sim_kinematic.tasks.skills.control import SkillControl
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.task import Task, TaskUsage
from sim_kinematic.tasks.wander import Wander

__all__ = [
    "BaseSpec",
    "Control",
    "Episode",
    "EpisodeCodec",
    "Rearrange",
    "RearrangeCodec",
    "RearrangeSpec",
    "Session",
    "SkillControl",
    "SocialNav",
    "SocialNavSpec",
    "StepOutcome",
    "Task",
    "TaskCodec",
    "TaskSpec",
    "TaskUsage",
    "VelocityControl",
    "WalkerSpec",
    "Wander",
    "WorldRollout",
    "find_task",
    "generator",
    "sample_starts",
    "with_oracle_skills",
]
