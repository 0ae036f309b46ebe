"""Modules and objects that were renamed: importing an old name fails and states the new one. There are no aliases."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import MappingProxyType, ModuleType
from typing import Any

MOVED = {
    "sim_kinematic.agents.sitting": "sim_kinematic.agents.driven.person",
    "h3data.bodies.robots.extents": "h3data.bodies.robots.robot_loading",
    "h3data.scene.freespace.floor_map": "h3data.scene.freespace.build",
    "h3data.recording.mcap.chunks": "h3data.recording.mcap.writer",
    "h3data.commands.shards": "h3data.commands.executors",
    "sim_kinematic.tasks.rearrange.solo": "sim_kinematic.tasks.rearrange.codec",
    "h3data.recording.parquet.steps": "h3data.recording.parquet.dataset",
    "sim_kinematic.policies.learned_chooser": "sim_kinematic.policies.rearrange",
    "sim_kinematic.policies.skills.observations": "sim_kinematic.policies.skills.player",
    "h3data.scene.freespace.distance_field": "h3data.scene.freespace.free_space",
    "h3data.bodies.robots.stand_ins": "h3data.bodies.robots.robot_loading",
    "h3data.replay.link_poses": "h3data.replay.posed_recording",
    "h3data.replay.recorded_gestures": "h3data.replay.posed_recording",
    "sim_kinematic.policies.maneuvering": "sim_kinematic.policies.social_nav",
    "sim_kinematic.tasks.rules.oracle": "sim_kinematic.tasks.social_nav",
    "h3data.recording.mcap.rows": "h3data.recording.mcap.writer",
    "h3data_training.held": "h3data_training.worlds",
    "h3data.recording.mcap.log": "h3data.recording.mcap.writer",
    "sim_kinematic.tasks.social_nav.episode": "sim_kinematic.tasks.social_nav",
    "sim_kinematic.tasks.social_nav.codec": "sim_kinematic.tasks.social_nav",
    "sim_kinematic.tasks.social_nav.task": "sim_kinematic.tasks.social_nav",
    "sim_kinematic.tasks.runner": "sim_kinematic.tasks.play",
    "sim_kinematic.tasks.motion": "sim_kinematic.tasks.control",
    "sim_kinematic.tasks.describe": "sim_kinematic.tasks.sources",
    "sim_kinematic.crowd.routines": "h3data_crowds.routines",
    "sim_kinematic.contact.overlaps": "h3data_pipelines.validation.overlaps",
    "sim_kinematic.controllers": "sim_kinematic.tasks.control",
    "sim_kinematic.controllers.controller": "sim_kinematic.tasks.control",
    "sim_kinematic.controllers.motion": "sim_kinematic.tasks.control",
    "sim_kinematic.controllers.skill": "sim_kinematic.tasks.skills.controller",
    "sim_kinematic.tasks.team": "sim_kinematic.tasks.control",
    "h3data.render.raster.vectors": "h3data.kernels.vectors",
    "h3data.render.light.bake": "h3data_light.bake",
    "h3data.render.light.direct": "h3data_light.direct",
    "h3data.render.light.exposure": "h3data_light.exposure",
    "h3data.render.light.field": "h3data_light.field",
    "h3data.render.light.outdoors": "h3data_light.outdoors",
    "h3data.render.light.probes": "h3data_light.probes",
    "h3data.render.light.refine": "h3data_light.refine",
    "h3data.render.light.store": "h3data_light.store",
    "h3data.render.light.voxels": "h3data_light.voxels",
    "sim_kinematic.agents.arm_contact": "h3data_pipelines.machine.arm_contact",
    "sim_kinematic.tasks.social_nav.sets": "h3data_pipelines.assets.set_episodes",
    "h3data.replay.follow": "h3data_motion.pictures",
    "h3data.render.rays": "h3data_rays.rays",
    "h3data.render.ray_cameras": "h3data_rays.cameras",
    "h3data.render.hybrid": "h3data_rays.engine",
    "sim_kinematic.tasks.skills.skill_judging": "h3data_pipelines.skill_judging",
    "h3data.metrics.explain": "h3data_pipelines.metric_texts",
    "h3data.recording.windows": "h3data_training.samples.windows",
    "h3data.recording.parquet.cache": "h3data_training.samples.cache",
    "h3data.render.flow": "h3data_pipelines.pictures.flow",
    "h3data.render.boxes": "h3data_pipelines.pictures.boxes",
    "h3data.metrics.table_files": "h3data_pipelines.metric_files",
    "h3data.bodies.robots.guess": "h3data_worlds.robot_guess",
    "h3data.bodies.robots.resting": "h3data_worlds.robot_posture",
    "sim_kinematic.tasks.crowd_nav": "h3data_crowds",
    "sim_kinematic.tasks.crowd_nav.task": "h3data_crowds.crowd_nav",
    "sim_kinematic.tasks.scenarios": "h3data_crowds",
    "sim_kinematic.tasks.scenarios.task": "h3data_crowds.scenarios",
    "sim_kinematic.tasks.scenarios.cards": "h3data_crowds.cards",
    "sim_kinematic.tasks.scenarios.places": "h3data_crowds.places",
    "sim_kinematic.policies.crowd.robots": "h3data_crowds.robots",
    "sim_kinematic.policies.crowd.scripted": "h3data_crowds.scripted",
    "sim_kinematic.envs.dataset_env": "h3data_training.envs.dataset_env",
    "h3data.render.id_png": "h3data_pipelines.pictures.id_png",
    "h3data.mesh.glb_write": "h3data_exporters.glb_write",
    "h3data.bodies.walk_synthesis": "h3data_motion.walk_synthesis",
    "h3data.bodies.robots.mjcf": "h3data_worlds.mjcf",
    "h3data.metrics.field": "h3data_social.field",
    "h3data.metrics.social": "h3data_social.people",
    "sim_kinematic.agents.contact_tracker": "sim_kinematic.agents.giving_way",
    "sim_kinematic.envs.skill_stepper": "sim_kinematic.envs.world_stepper",
    "sim_kinematic.tasks.rearrange.control": "sim_kinematic.tasks.skills.control",
    "sim_kinematic.tasks.rearrange.kept_track": "sim_kinematic.tasks.skills.kept_track",
    "sim_kinematic.tasks.rearrange.oracle": "sim_kinematic.tasks.skills.errands",
    "sim_kinematic.tasks.rearrange.skill_judging": "h3data_pipelines.skill_judging",
    "sim_kinematic.tasks.rearrange.skill_starts": "sim_kinematic.tasks.skills.skill_starts",
    "sim_kinematic.tasks.rearrange.play": "sim_kinematic.tasks.skills.household",
    "h3data_habitat.episodes.episode_files": "h3data_habitat.episodes.files",
    "h3data_habitat.episodes.episode_objects": "h3data_habitat.episodes.objects",
    "h3data_habitat.episodes.episode_scenes": "h3data_habitat.episodes.scenes",
    "h3data_habitat.gfx.gfx_agents": "h3data_habitat.gfx.agents",
    "h3data_habitat.gfx.gfx_fold": "h3data_habitat.gfx.fold",
    "h3data_habitat.gfx.gfx_keyframes": "h3data_habitat.gfx.keyframes",
    "h3data_habitat.gfx.gfx_replay": "h3data_habitat.gfx.replay",
    "h3data_habitat.hitl.hitl_agents": "h3data_habitat.hitl.agents",
    "h3data_habitat.hitl.hitl_episode": "h3data_habitat.hitl.episode",
    "h3data_habitat.hitl.hitl_outcomes": "h3data_habitat.hitl.outcomes",
    "h3data_habitat.hitl.hitl_paper_logs": "h3data_habitat.hitl.paper_logs",
    "h3data_habitat.hitl.hitl_pickled_logs": "h3data_habitat.hitl.pickled_logs",
    "h3data_habitat.hitl.hitl_scenes": "h3data_habitat.hitl.scenes",
    "h3data_habitat.hitl.hitl_sessions": "h3data_habitat.hitl.sessions",
    "h3data_habitat.hitl.hitl_users": "h3data_habitat.hitl.users",
    "h3data_habitat.motion.motion_reader": "h3data_habitat.motion.reader",
    "h3data_habitat.navmesh.navmesh_file": "h3data_habitat.navmesh.file",
    "h3data_viewers.html_report.report_charts": "h3data_viewers.html_report.charts",
    "h3data_viewers.html_report.report_data": "h3data_viewers.html_report.data",
    "h3data_viewers.html_report.report_episode": "h3data_viewers.html_report.episode",
    "h3data_viewers.html_report.report_evaluations": "h3data_viewers.html_report.evaluations",
    "h3data_viewers.html_report.report_paper": "h3data_viewers.html_report.paper",
    "h3data_viewers.html_report.report_pictures": "h3data_viewers.html_report.pictures",
    "h3data_viewers.html_report.report_reading": "h3data_viewers.html_report.reading",
    "h3data_viewers.html_report.report_svg": "h3data_viewers.html_report.svg",
    "h3data_viewers.html_report.report_tables": "h3data_viewers.html_report.tables",
    "h3data_viewers.html_report.report_text": "h3data_viewers.html_report.text",
    "h3data_pipelines.benchmark.agents": "h3data_pipelines.machine.bench_agents",
    "h3data_pipelines.benchmark.protocol": "h3data_pipelines.machine.bench_protocol",
    "h3data.bodies.motion.habitat_humanoid": "h3data_habitat.motion.habitat_humanoid",
    "h3data.bodies.motion.habitat_motion": "h3data_habitat.motion.habitat_motion",
    "h3data.bodies.motion.habitat_pick": "h3data_habitat.motion.habitat_pick",
    "h3data.exporters": "h3data_exporters",
    "h3data.exporters.camera_videos": "h3data.replay.camera_videos",
    "h3data.exporters.gfx_replay_export": "h3data_habitat.exporters.gfx_replay_export",
    "h3data.exporters.habitat": "h3data_habitat.exporters",
    "h3data.habitat": "h3data_habitat",
    "h3data.bodies.motion": "h3data_motion",
    "h3data.bodies.motion.motion_clip": "h3data_motion.clip",
    "h3data.bodies.motion.motion_cycle": "h3data_motion.cycle",
    "h3data.bodies.motion.motion_files": "h3data_motion.files",
    "h3data.bodies.motion.motion_gait": "h3data_motion.gait",
    "h3data.bodies.motion.motion_retarget": "h3data_motion.retarget",
    "h3data.bodies.motion.walk_import": "h3data_motion.walks",
    "h3data.bodies.motion.walk_names": "h3data.bodies.names",
    "h3data.recording.assets.stand_ins": "h3data_habitat.stand_ins",
    "h3data.exporters.csv_tables": "h3data_exporters.csv_tables",
    "h3data.exporters.foxglove": "h3data_exporters.foxglove",
    "h3data.exporters.lerobot_export": "h3data_exporters.lerobot",
    "h3data.exporters.rigid_pieces": "h3data_exporters.foxglove.rigid_pieces",
    "h3data.exporters.robomimic": "h3data_exporters.robomimic",
    "h3data.exporters.transitions": "h3data_exporters.transitions",
    "h3data.habitat.asset_folders": "h3data.recording.assets.folders",
    "h3data.habitat.asset_library": "h3data.recording.assets.library",
    "h3data.habitat.episodes.episode_summary": "h3data_pipelines.commands.episode_summary",
    "h3data.habitat.episodes.partnr_goals": "h3data.recording.task_episodes.partnr_goals",
    "h3data.habitat.episodes.rearrange_episode": "h3data.recording.task_episodes.rearrange_episode",
    "h3data.habitat.episodes.social_nav_episodes": "h3data.recording.task_episodes.social_nav_episodes",
    "h3data.habitat.episodes.stored_episodes": "h3data.recording.task_episodes.stored_episodes",
    "h3data.habitat.episodes.stored_rearrangements": "h3data.recording.task_episodes.stored_rearrangements",
    "h3data.habitat.hitl.session_manifest": "h3data_pipelines.session_manifest",
    "h3data.habitat.placeholders": "h3data.recording.assets.placeholders",
    "h3data.habitat.scene_names": "h3data.scene.open",
    "h3data.habitat.scenes.object_handles": "h3data.recording.assets.handles",
    "h3data.habitat.skinned_meshes": "h3data.recording.assets.skinned_meshes",
    "h3data.metrics.habitat": "h3data_habitat.metrics",
    "h3data.metrics.habitat.config": "h3data.metrics.habitat_settings",
    "h3data.mesh.readers": "h3data_meshes",
    "h3data.metrics.studies": "h3data_studies.analysis",
    "h3data.recording.motion_recording": "h3data_motion.recording",
    "h3data.render.gpu": "h3data_gpu",
    "h3data.render.sheets.motion_sheet": "h3data_motion.pictures",
    "h3data.scene.homes": "h3data_homes",
    "h3data.scene.navmesh": "h3data_habitat.navmesh",
    "h3data.stats.glmm_design": "h3data_studies.statistics.glmm_design",
    "h3data.stats.laplace": "h3data_studies.statistics.laplace",
    "h3data.stats.mixed_models": "h3data_studies.statistics.mixed_models",
    "h3data.stats.nested_elimination": "h3data_studies.statistics.nested_elimination",
    "h3data.stats.posthoc": "h3data_studies.statistics.posthoc",
    "h3data.stats.rank_agreement": "h3data_studies.statistics.rank_agreement",
    "h3data_habitat.navmesh_file": "h3data_habitat.navmesh.file",
    "h3data_pipelines.assets.motion": "h3data_motion.commands",
    "h3data_pipelines.command": "h3data.commands.command",
    "h3data_pipelines.commands.playing": "h3data_play.commands.playing",
    "h3data_pipelines.commands.serving": "h3data_play.commands.serving",
    "h3data_pipelines.execution.executors": "h3data.commands.executors",
    "h3data_pipelines.execution.shards": "h3data.commands.executors",
    "h3data_pipelines.learning": "h3data_training.commands",
    "h3data_pipelines.options": "h3data.commands.options",
    "h3data_pipelines.pictures.report": "h3data_viewers.commands.reporting",
    "h3data_pipelines.pictures.viewing": "h3data_viewers.commands.viewing",
    "h3data_pipelines.studies": "h3data_studies.commands",
    "h3data_viewers.hitl": "h3data_play",
    "h3data_viewers.hitl.bots": "h3data_studies.bots",
    "h3data_viewers.hitl.study": "h3data_studies",
    "h3data_viewers.html_report.report_ranks": "h3data_studies.analysis.ranks",
    "h3data_viewers.html_report.report_study": "h3data_studies.analysis.tables",
    "h3data_viewers.rigs": "h3data.replay.rigs",
    "sim_kinematic.agents.penetration": "h3data_pipelines.validation.penetration",
    "sim_kinematic.envs.rearrange_torch_env": "h3data_training.envs.rearrange_torch_env",
    "sim_kinematic.envs.social_nav_torch_env": "h3data_training.envs.social_nav_torch_env",
    "sim_kinematic.envs.torch_env": "h3data_training.envs.torch_env",
    "sim_kinematic.motion.habitat_slide": "h3data_habitat.navmesh.slide",
    "sim_kinematic.policies.pictured": "sim_kinematic.policies.visual_policy",
    "sim_kinematic.tasks.rearrange.storage": "sim_kinematic.tasks.rearrange.codec",
    "sim_kinematic.tasks.social_nav.storage": "sim_kinematic.tasks.social_nav",
    "sim_kinematic.tasks.storage": "sim_kinematic.tasks.codec",
    "sim_kinematic.torch": "h3data_training.torch",
    "h3data.bodies.people.foot_planting": "h3data.bodies.people.soles",
    "h3data.bodies.people.skinning_torch": "h3data_gpu.skinning",
    "h3data.formats.json_files": "h3data_habitat.json_files",
    "h3data.formats.json_stream": "h3data_habitat.json_stream",
    "h3data.limits": "h3data_habitat.limits",
    "h3data.npz_arrays": "h3data_motion.amass",
    "h3data.safe_pickle": "h3data_habitat.safe_pickle",
    "h3data.mesh.meshopt": "h3data_meshes.meshopt",
    "h3data.metrics.paper.oracle": "h3data_habitat.metrics.oracle",
    "h3data.metrics.partnr": "h3data_language.evaluation.profile",
    "h3data_habitat.metrics.partnr": "h3data_language.evaluation.profile",
    "h3data.recording.session_manifest": "h3data_pipelines.session_manifest",
    "h3data.recording.task_episodes.episode_summary": "h3data_pipelines.commands.episode_summary",
    "h3data.render.sheets.robot_sheet": "h3data_pipelines.assets.turntable",
    "h3data.replay.strip": "h3data_viewers.strip",
    "h3data.replay.validation": "h3data_pipelines.validation.recordings",
    "h3data.scene.validation": "h3data_pipelines.validation.scenes",
    "h3data_pipelines.commands.penetration": "h3data_pipelines.validation.penetration",
}
"""New name of each module that was renamed. For packages that moved as a whole, the table has the name of the package
only."""

RENAMED = {
    "h3data.formats.export_format": "h3data_pipelines.format_names.export_format",
    "h3data.formats.import_suffixes": "h3data_pipelines.format_names.import_suffixes",
    "h3data.replay.follow_camera": "h3data_motion.pictures.follow_camera",
    "h3data.render.RayCaster": "h3data_rays.RayCaster",
    "h3data.render.lidar": "h3data_rays.lidar",
    "h3data.metrics.events_of": "h3data_pipelines.metric_files.events_of",
    "h3data.metrics.explain": "h3data_pipelines.metric_texts.explain",
    "h3data.metrics.explain_episode": "h3data_pipelines.metric_texts.explain_episode",
    "h3data.metrics.list_metrics": "h3data_pipelines.metric_texts.list_metrics",
    "h3data.metrics.write_events": "h3data_pipelines.metric_files.write_events",
    "h3data.metrics.write_series": "h3data_pipelines.metric_files.write_series",
    "h3data.metrics.write_table": "h3data_pipelines.metric_files.write_table",
    "h3data.recording.WindowDataset": "h3data_training.samples.WindowDataset",
    "h3data.render.Boxes": "h3data_pipelines.pictures.boxes.Boxes",
    "h3data.render.flow_to_rgb": "h3data_pipelines.pictures.flow.flow_to_rgb",
    "h3data.render.optical_flow": "h3data_pipelines.pictures.flow.optical_flow",
    "h3data.render.visible_boxes": "h3data_pipelines.pictures.boxes.visible_boxes",
    "h3data.render.visible_masks": "h3data_pipelines.pictures.boxes.visible_masks",
    "h3data.metrics.Block": "h3data_studies.analysis.Block",
    "h3data.metrics.Estimate": "h3data_studies.analysis.Estimate",
    "h3data.metrics.FittedMeans": "h3data_studies.analysis.FittedMeans",
    "h3data.metrics.Power": "h3data_studies.analysis.Power",
    "h3data.metrics.Session": "h3data_studies.analysis.Session",
    "h3data.metrics.StudyAnalysis": "h3data_studies.analysis.StudyAnalysis",
    "h3data.metrics.StudyModel": "h3data_studies.analysis.StudyModel",
    "h3data.metrics.analyse_study": "h3data_studies.analysis.analyse_study",
    "h3data.metrics.latin_square": "h3data_studies.analysis.latin_square",
    "h3data.metrics.plan_sessions": "h3data_studies.analysis.plan_sessions",
    "h3data.metrics.read_session": "h3data_studies.analysis.read_session",
    "h3data.metrics.simulate_power": "h3data_studies.analysis.simulate_power",
    "h3data.metrics.simulate_study": "h3data_studies.analysis.simulate_study",
    "h3data.metrics.study_rows": "h3data_studies.analysis.study_rows",
    "h3data.metrics.write_sessions": "h3data_studies.analysis.write_sessions",
    "h3data.scene.HOME_PRESETS": "h3data_homes.HOME_PRESETS",
    "h3data.scene.HomePreset": "h3data_homes.HomePreset",
    "h3data.scene.HomeSpec": "h3data.scenes.HomeSpec",
    "h3data.scene.build_home": "h3data.scenes.build_home",
    "h3data.stats.Adjustment": "h3data_studies.statistics.Adjustment",
    "h3data.stats.Contrast": "h3data_studies.statistics.Contrast",
    "h3data.stats.Family": "h3data_studies.statistics.Family",
    "h3data.stats.FixedDesign": "h3data_studies.statistics.FixedDesign",
    "h3data.stats.GlmmFit": "h3data_studies.statistics.GlmmFit",
    "h3data.stats.MarginalMeans": "h3data_studies.statistics.MarginalMeans",
    "h3data.stats.RankAgreement": "h3data_studies.statistics.RankAgreement",
    "h3data.stats.RelativeEfficiency": "h3data_studies.statistics.RelativeEfficiency",
    "h3data.stats.SeparationError": "h3data_studies.statistics.SeparationError",
    "h3data.stats.contrasts": "h3data_studies.statistics.contrasts",
    "h3data.stats.contrasts_text": "h3data_studies.statistics.contrasts_text",
    "h3data.stats.fit_glmm": "h3data_studies.statistics.fit_glmm",
    "h3data.stats.marginal_means": "h3data_studies.statistics.marginal_means",
    "h3data.stats.rank_agreement": "h3data_studies.statistics.rank_agreement",
    "h3data.stats.relative_efficiency": "h3data_studies.statistics.relative_efficiency",
    "h3data_viewers.ShownRecording": "ViewedRecording",
    "sim_kinematic.agents.skills.Ending": "SkillResult",
    "sim_kinematic.policies.policy.KeptMoment": "RecordedPose",
    "sim_kinematic.policies.policy.PaceTo": "GaitAction",
    "sim_kinematic.policies.policy.StrideTo": "PoseAction",
    "sim_kinematic.policies.policy.Towards": "WaypointAction",
    "sim_kinematic.sensing.table.Moment": "SensorContext",
    "sim_kinematic.sensing.sensor.humanoid_gps": "gps_compass",
    "sim_kinematic.sensing.sensor.nav_goal": "gps_compass",
    "sim_kinematic.tasks.episode.Outcome": "StepOutcome",
    "sim_kinematic.tasks.play.Play": "WorldRollout",
    "sim_kinematic.tasks.play.WorldPlay": "WorldRollout",
    "sim_kinematic.tasks.play.Rollout": "WorldRollout",
    "sim_kinematic.tasks.resume.AddedTime": "h3data_pipelines.validation.added_time.AddedTime",
    "sim_kinematic.tasks.resume.added_time": "h3data_pipelines.validation.added_time.added_time",
    "sim_kinematic.tasks.play.Session": "sim_kinematic.tasks.sessions.Session",
    "sim_kinematic.tasks.play.StepResult": "sim_kinematic.tasks.sessions.StepResult",
    "sim_kinematic.tasks.play.Turns": "DecisionLoop",
    "sim_kinematic.tasks.play.rollout": "WorldRollout",
    "sim_kinematic.tasks.play.run": "sim_kinematic.tasks.recorder.run",
    "sim_kinematic.tasks.play.simulate": "sim_kinematic.tasks.recorder.simulate",
    "sim_kinematic.world.Drive": "DriveCommand",
    "sim_kinematic.world.Keep": "RecordedPoseCommand",
    "sim_kinematic.world.Pace": "GaitCommand",
    "sim_kinematic.world.Stride": "PoseCommand",
    "sim_kinematic.world.WalkTo": "WaypointCommand",
}
"""New name of each public object that was renamed: in the same module, or with its new module if the object moved to
another one. `announce_moves` makes old modules raise an error for old names; modules with a ``__getattr__`` use
`lazy_names`."""


def lazy_names(module: str, homes: Mapping[str, str] = MappingProxyType({})) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a module that imports names at their first use.

    For old names in `RENAMED` it raises an ImportError that states the new name.

    Args:
        module: Name of the module.
        homes: Module that defines each name; a name that starts with a dot is relative to the package ``module``.
    """

    def find(name: str) -> Any:
        if name in homes:
            from h3data.plugins import import_name

            return import_name(f"{module}{homes[name]}" if homes[name].startswith(".") else homes[name], name)
        new = RENAMED.get(f"{module}.{name}")
        if new is None:
            more = f"; it has {', '.join(homes)}" if homes else ""
            raise AttributeError(f"module {module!r} has no attribute {name!r}{more}")
        # not an AttributeError: ``from module import name`` would replace its text
        raise ImportError(f"{module}.{name} is {new} now.", name=module)

    return find


def new_name(module: str) -> str | None:
    """Return the name that a module of an earlier version has now; None if it has not moved."""
    old = module
    # from the module outwards: what is inside a package that has moved as a whole has moved with it
    while old and old not in MOVED:
        old = old.rpartition(".")[0]
    return MOVED[old] + module[len(old) :] if old else None


class MovedFinder:
    """Import finder of last resort, for modules that no other finder has found."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Raise a ModuleNotFoundError with the new name of a module that has moved; None for all others."""
        now = new_name(fullname)
        if now is not None:
            # Python asks for packages before what is in them, so that only the outermost old name is ever seen here
            parts = [f"{old} is {new}" for old, new in MOVED.items() if old.startswith(f"{fullname}.")]
            raise ModuleNotFoundError(
                f"{', and '.join([f'The module {fullname} is {now} now', *parts])}.", name=fullname
            )
        return None


class RenamedFinder(PathFinder):
    """Import finder that adds a ``__getattr__`` (`lazy_names`) to modules whose objects were renamed."""

    modules = frozenset(name.rpartition(".")[0] for name in RENAMED)
    """Names of modules whose objects were renamed."""
    folders = frozenset(name.rpartition(".")[0] for name in MOVED)
    """Names of packages, some of which are single modules now, from which modules have moved."""

    @classmethod
    def find_spec(
        cls, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the module's own specification; None for modules without renamed objects."""
        is_renamed, had_modules = fullname in cls.modules, fullname in cls.folders
        spec = super().find_spec(fullname, path, target) if is_renamed or had_modules else None
        if spec is not None and spec.submodule_search_locations is None and had_modules:
            # Python asks `MovedFinder` only for modules in packages
            spec.submodule_search_locations = []
        if is_renamed and spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_guarded(module: ModuleType) -> None:
                vars(module)["__getattr__"] = lazy_names(fullname)
                run(module)

            spec.loader.exec_module = run_guarded
        return spec


def announce_moves() -> None:
    """Make imports of old names fail with the new names, in this process."""
    if not any(isinstance(finder, MovedFinder) for finder in sys.meta_path):
        sys.meta_path[:] = [RenamedFinder, *sys.meta_path, MovedFinder()]
