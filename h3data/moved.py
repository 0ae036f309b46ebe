"""Modules and objects that were renamed: importing an old name fails and says the new one. There are no aliases."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED = {
    "h3data_pipelines.benchmark.agents": "h3data_pipelines.machine.bench_agents",
    "h3data_pipelines.benchmark.protocol": "h3data_pipelines.machine.bench_protocol",
    "h3data.habitat.asset_folders": "h3data.recording.assets.folders",
    "h3data.habitat.asset_library": "h3data.recording.assets.library",
    "h3data.habitat.episodes.partnr_goals": "h3data.recording.task_episodes.partnr_goals",
    "h3data.habitat.episodes.rearrange_episode": "h3data.recording.task_episodes.rearrange_episode",
    "h3data.habitat.episodes.social_nav_episodes": "h3data.recording.task_episodes.social_nav_episodes",
    "h3data.habitat.episodes.stored_episodes": "h3data.recording.task_episodes.stored_episodes",
    "h3data.habitat.episodes.stored_rearrangements": "h3data.recording.task_episodes.stored_rearrangements",
    "h3data.habitat.navmesh": "h3data.scene.navmesh",
    "h3data.habitat.navmesh.navmesh_file": "h3data.habitat.navmesh_file",
    "h3data.habitat.placeholders": "h3data.recording.assets.placeholders",
    "h3data.habitat.scene_names": "h3data.scene.open",
    "h3data.habitat.scenes.object_handles": "h3data.recording.assets.handles",
    "h3data.habitat.skinned_meshes": "h3data.recording.assets.skinned_meshes",
    "h3data.scene.homes": "h3data_homes",
    "h3data_pipelines.command": "h3data.commands.command",
    "h3data_pipelines.commands.playing": "h3data_play.commands.playing",
    "h3data_pipelines.commands.serving": "h3data_play.commands.serving",
    "h3data_pipelines.execution.executors": "h3data.commands.executors",
    "h3data_pipelines.execution.shards": "h3data.commands.shards",
    "h3data_pipelines.learning": "h3data_training.commands",
    "h3data_pipelines.options": "h3data.commands.options",
    "h3data_pipelines.pictures.report": "h3data_viewers.commands.reporting",
    "h3data_pipelines.pictures.viewing": "h3data_viewers.commands.viewing",
    "h3data_pipelines.studies": "h3data_studies.commands",
    "h3data_viewers.hitl": "h3data_play",
    "h3data_viewers.hitl.bots": "h3data_studies.bots",
    "h3data_viewers.hitl.study": "h3data_studies",
    "h3data_viewers.rigs": "h3data.replay.rigs",
    "sim_kinematic.envs.rearrange_torch_env": "h3data_training.envs.rearrange_torch_env",
    "sim_kinematic.envs.social_nav_torch_env": "h3data_training.envs.social_nav_torch_env",
    "sim_kinematic.envs.torch_env": "h3data_training.envs.torch_env",
    "sim_kinematic.policies.pictured": "sim_kinematic.policies.visual_policy",
    "sim_kinematic.tasks.rearrange.storage": "sim_kinematic.tasks.rearrange.codec",
    "sim_kinematic.tasks.social_nav.storage": "sim_kinematic.tasks.social_nav.codec",
    "sim_kinematic.tasks.storage": "sim_kinematic.tasks.codec",
    "sim_kinematic.torch": "h3data_training.torch",
}
"""New name of each module that was renamed; modules in a package that has moved as a whole follow its name."""

RENAMED = {
    "h3data.scene.HomePreset": "h3data_homes.HomePreset",
    "h3data.scene.HomeSpec": "h3data.scenes.HomeSpec",
    "h3data.scene.HOME_PRESETS": "h3data_homes.HOME_PRESETS",
    "h3data.scene.build_home": "h3data.scenes.build_home",
    "sim_kinematic.agents.skills.Ending": "SkillResult",
    "sim_kinematic.policies.policy.KeptMoment": "RecordedPose",
    "sim_kinematic.policies.policy.PaceTo": "GaitAction",
    "sim_kinematic.policies.policy.StrideTo": "PoseAction",
    "sim_kinematic.policies.policy.Towards": "WaypointAction",
    "sim_kinematic.sensing.table.Moment": "SensorContext",
    "sim_kinematic.tasks.episode.Outcome": "StepOutcome",
    "sim_kinematic.tasks.play.Play": "Rollout",
    "sim_kinematic.tasks.play.WorldPlay": "WorldRollout",
    "sim_kinematic.tasks.rearrange.play.AgentRun": "SkillExecutor",
    "sim_kinematic.tasks.rearrange.play.RearrangePlay": "SkillRollout",
    "sim_kinematic.tasks.rearrange.play.RearrangeRollout": "SkillRollout",
    "sim_kinematic.tasks.runner.Turns": "DecisionLoop",
    "sim_kinematic.world.Drive": "DriveCommand",
    "sim_kinematic.world.Keep": "RecordedPoseCommand",
    "sim_kinematic.world.Pace": "GaitCommand",
    "sim_kinematic.world.Stride": "PoseCommand",
    "sim_kinematic.world.WalkTo": "WaypointCommand",
}
"""New name of each public object that was renamed: in the same module, or with the new one before it if it has moved alone.

The old module calls `refuse_renamed`.
"""


def refuse_renamed(module: str) -> Callable[[str], Any]:
    """Makes a module's ``__getattr__``, which answers old names of `RENAMED` with an ImportError that says the new one.

    Assign it inside ``if not TYPE_CHECKING``: type checkers take a module with a ``__getattr__`` to have every name.
    """

    def refuse(name: str) -> Any:
        new = RENAMED.get(f"{module}.{name}")
        if new is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        # not an AttributeError: ``from module import name`` would replace its text
        raise ImportError(f"{module}.{name} is {new} now.", name=module)

    return refuse


def new_name(module: str) -> str | None:
    """The name that a module of an earlier version has now; None if it has not moved."""
    old = module
    while old and old not in MOVED:
        old = old.rpartition(".")[0]
    return MOVED[old] + module[len(old) :] if old else None


class MovedFinder(MetaPathFinder):
    """Asked last, for modules that nothing else has found."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Raises a ModuleNotFoundError with the new name of a module that has moved; None for all others."""
        now = new_name(fullname)
        if now is not None:
            # Python asks for packages before what is in them, so that only the outermost old name is ever seen here
            parts = [f"{old} is {new}" for old, new in MOVED.items() if old.startswith(f"{fullname}.")]
            raise ModuleNotFoundError(
                f"{', and '.join([f'The module {fullname} is {now} now', *parts])}.", name=fullname
            )
        return None


def announce_moves() -> None:
    """Makes imports of old names say the new ones, in this process."""
    if not any(isinstance(finder, MovedFinder) for finder in sys.meta_path):
        sys.meta_path.append(MovedFinder())
