"""Keys of Habitat's configs that are read, and the reasons why others are not: the table of h3data docs scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

ConfigKind = Literal[
    "scene_dataset_config",
    "dataset_section",
    "dataset_override",
    "scene_instance",
    "stage_instance",
    "object_instance",
    "articulated_instance",
    "stage_config",
    "object_config",
    "ao_config",
    "receptacle",
    "lighting_config",
    "light",
    "semantic_config",
    "region",
    "rec_filter",
]

_DYNAMICS = "forces and friction: nothing is moved by forces here"
_SHADING = "one way of shading for all"
_MARKERS = "points for manipulation, no part of the scene"
_NOTES = "free notes of the author"
_RULES = "the lists of what was left out; only `active` counts, as in habitat-lab's simulator"
_SEMANTIC_MESH = "labels per triangle of scans: instances carry the semantic ids"

_BODY = {
    "margin": _DYNAMICS,
    "mass": _DYNAMICS,
    "friction_coefficient": _DYNAMICS,
    "restitution_coefficient": _DYNAMICS,
    "rolling_friction_coefficient": _DYNAMICS,
    "spinning_friction_coefficient": _DYNAMICS,
    "shader_type": _SHADING,
    "force_flat_shading": _SHADING,
    "requires_lighting": _SHADING,
    "render_asset_type": "the file itself says what it is",
    "collision_asset_type": "the file itself says what it is",
    "marker_sets": _MARKERS,
}

READ: Mapping[ConfigKind, tuple[str, ...]] = {
    "scene_dataset_config": (
        "stages",
        "objects",
        "articulated_objects",
        "light_setups",
        "scene_instances",
        "navmesh_instances",
        "semantic_scene_descriptor_instances",
    ),
    "dataset_section": ("default_attributes", "paths", "configs"),
    "dataset_override": ("original_file", "template_handle", "attributes"),
    "scene_instance": (
        "translation_origin",
        "stage_instance",
        "object_instances",
        "articulated_object_instances",
        "default_lighting",
        "navmesh_instance",
        "semantic_scene_instance",
        "user_defined",
    ),
    "stage_instance": ("template_name", "translation", "rotation"),
    "object_instance": (
        "template_name",
        "translation",
        "rotation",
        "translation_origin",
        "motion_type",
        "uniform_scale",
        "non_uniform_scale",
        "is_instance_visible",
    ),
    "articulated_instance": (
        "template_name",
        "translation",
        "rotation",
        "uniform_scale",
        "non_uniform_scale",
        "initial_joint_pose",
        "auto_clamp_joint_limits",
        "link_order",
        "render_mode",
        "is_instance_visible",
    ),
    "stage_config": (
        "render_asset",
        "collision_asset",
        "up",
        "front",
        "scale",
        "units_to_meters",
        "nav_asset",
        "navmesh_asset",
        "user_defined",
    ),
    "object_config": (
        "render_asset",
        "collision_asset",
        "collision_asset_size",
        "up",
        "front",
        "scale",
        "units_to_meters",
        "COM",
        "compute_COM_from_shape",
        "semantic_id",
        "is_collidable",
        "use_bounding_box_for_collision",
        "join_collision_meshes",
        "user_defined",
    ),
    "ao_config": (
        "urdf_filepath",
        "uniform_scale",
        "semantic_id",
        "link_order",
        "render_mode",
        "render_asset",
        "user_defined",
    ),
    "receptacle": ("name", "position", "scale", "rotation", "mesh_filepath", "parent_link"),
    "lighting_config": ("lights", "positive_intensity_scale", "negative_intensity_scale"),
    "light": ("type", "position", "direction", "intensity", "color", "position_model", "spot"),
    "semantic_config": ("region_annotations", "semantic_descriptor_filename"),
    "region": ("name", "label", "poly_loop", "floor_height", "min_bounds", "max_bounds"),
    "rec_filter": ("active", "within_set"),
}
"""Keys that are read, by the kind of JSON object."""

IGNORED: Mapping[ConfigKind, Mapping[str, str]] = {
    "scene_dataset_config": {"pbr_ibl_configs": _SHADING, "dataset_name": _NOTES, "user_defined": _NOTES},
    "dataset_section": {},
    "dataset_override": {},
    "scene_instance": {"default_pbr_shader_config": _SHADING, "pbr_shader_region_configs": _SHADING},
    "stage_instance": {
        "translation_origin": "the stage stands at the origin, as in habitat-sim",
        "motion_type": "a stage never moves",
        "shader_type": _SHADING,
        "user_defined": _NOTES,
    },
    "object_instance": {
        "mass_scale": _DYNAMICS,
        "apply_scale_to_mass": _DYNAMICS,
        "shader_type": _SHADING,
        "user_defined": _NOTES,
    },
    "articulated_instance": {
        "translation_origin": "the pose is always that of the base link's centre of mass, as in habitat-sim",
        "motion_type": "links move only as agents open and close them",
        "fixed_base": "links move only as agents open and close them",
        "base_type": "links move only as agents open and close them",
        "initial_joint_velocities": "links move only as agents open and close them",
        "inertia_source": _DYNAMICS,
        "mass_scale": _DYNAMICS,
        "apply_scale_to_mass": _DYNAMICS,
        "shader_type": _SHADING,
        "user_defined": _NOTES,
    },
    "stage_config": {
        **_BODY,
        "gravity": _DYNAMICS,
        "origin": "habitat-sim turns a stage by up and front, but does not shift it by origin",
        "is_collidable": "free floor comes from the stage's triangles",
        "use_bounding_box_for_collision": "free floor comes from the stage's triangles",
        "join_collision_meshes": "free floor comes from the stage's triangles",
        "collision_asset_size": "free floor comes from the stage's triangles",
        "semantic_asset": _SEMANTIC_MESH,
        "semantic_asset_type": _SEMANTIC_MESH,
        "semantic_up": _SEMANTIC_MESH,
        "semantic_front": _SEMANTIC_MESH,
        "has_semantic_textures": _SEMANTIC_MESH,
        "house_filename": _SEMANTIC_MESH,
        "semantic_descriptor_filename": _SEMANTIC_MESH,
        "lighting_setup": "lights come from the scene instance",
        "frustum_culling": _SHADING,
    },
    "object_config": {
        **_BODY,
        "inertia": _DYNAMICS,
        "linear_damping": _DYNAMICS,
        "angular_damping": _DYNAMICS,
        "is_visible": "the instance decides (is_instance_visible)",
    },
    "ao_config": {
        "base_type": "links move only as agents open and close them",
        "inertia_source": _DYNAMICS,
        "mass_scale": _DYNAMICS,
        "shader_type": _SHADING,
        "marker_sets": _MARKERS,
        "debug_render_primitives": "a debugging view",
    },
    "receptacle": {
        "up": "the box's axis that points up in the world is taken",
        "parent_object": "the file in which it stands says it",
    },
    "lighting_config": {"user_defined": _NOTES},
    "light": {"user_defined": _NOTES},
    "semantic_config": {"old_format_filename": _SEMANTIC_MESH, "user_defined": _NOTES},
    "region": {"extrusion_height": "a room is an area of the floor", "user_defined": _NOTES},
    "rec_filter": {
        "manually_filtered": _RULES,
        "access_filtered": _RULES,
        "stability_filtered": _RULES,
        "height_filtered": _RULES,
    },
}
"""Keys that are known and not read, with the reason."""

IGNORED_FILES: Mapping[str, str] = {
    ".scn": "labels per triangle of scans (Gibson): instances carry the semantic ids",
    ".physics_config.json": "settings of habitat-sim's physics, no part of a scene",
    ".pbr_config.json": "settings of habitat-sim's shader, no part of a scene",
    "navmeshsettings.json": "settings with which habitat-sim computes a navmesh; `FreeSpace` has its own",
}
"""Endings of config files that are not read at all."""


class KeyNotes:
    """Collection of the keys in the files of a scene that were not read."""

    def __init__(self) -> None:
        self.ignored: set[str] = set()
        """Known keys that are not read, such as ``object_config.mass`` (see `IGNORED`)."""
        self.unknown: set[str] = set()
        """Unknown keys, such as ``object_config.colour``."""

    def note(self, kind: ConfigKind, content: Mapping[str, Any]) -> None:
        """Collect the keys of a file that are ignored or unknown."""
        for key in content:
            if key in IGNORED[kind]:
                self.ignored.add(f"{kind}.{key}")
            elif key not in READ[kind]:
                self.unknown.add(f"{kind}.{key}"[:120])


def ignored_table() -> str:
    """Return the Markdown table of `IGNORED`: one row per reason."""
    rows: dict[str, dict[str, list[str]]] = {}
    for kind, keys in IGNORED.items():
        for key, reason in keys.items():
            rows.setdefault(reason, {}).setdefault(key, []).append(kind)
    lines = ["| not read | in | because |", "|---|---|---|"]
    for reason, keys in rows.items():
        kinds = list(dict.fromkeys(kind for of in keys.values() for kind in of))
        lines.append(f"| {', '.join(f'`{k}`' for k in keys)} | {', '.join(kinds)} | {reason} |")
    lines += [f"| whole files `*{ending}` | | {reason} |" for ending, reason in IGNORED_FILES.items()]
    return "\n".join(lines)
