"""Built-in file formats with the rules by which they are recognised.

The first format that matches is used, so the order matters.

Formats of Habitat and ROS are recognised here so that messages can name them. Their readers and writers are in
h3data_habitat and h3data_ros, which register them in the group ``h3data.formats`` and so replace these entries.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from h3data.formats.format import Format

REPLAY_MEMBERS = frozenset(
    {
        "loads",
        "rigCreations",
        "creations",
        "metadata",
        "deletions",
        "stateUpdates",
        "rigUpdates",
        "userTransforms",
        "lights",
        "lightsChanged",
    }
)
"""Members of a keyframe of a gfx-replay (spec/habitat.md 5.1)."""


def _is_replay(members: Mapping[str, Any], name: str) -> bool:
    """Return whether there are keyframes, and they hold something of a gfx-replay's or nothing at all."""
    keyframes = members.get("keyframes", [members["keyframe"]] if "keyframe" in members else None)
    if not isinstance(keyframes, list):
        return False
    objects = [keyframe for keyframe in keyframes if isinstance(keyframe, dict)]
    # empty keyframes alone are a replay in which nothing was drawn yet
    return not any(objects) or any(not REPLAY_MEMBERS.isdisjoint(keyframe) for keyframe in objects)


def _is_scene_dataset(members: Mapping[str, Any], name: str) -> bool:
    sections = members.keys() & {"stages", "objects", "articulated_objects", "light_setups", "scene_instances"}
    # other files have members of these names, but lists or numbers in them
    return bool(sections) and all(isinstance(members[section], dict) for section in sections)


def _has(*keys: str) -> Callable[[Mapping[str, Any], str], bool]:
    """Return whether all of ``keys`` are there."""
    return lambda members, name: members.keys() >= {*keys}


def _config(infix: str, *keys: str) -> Callable[[Mapping[str, Any], str], bool]:
    """Return whether the file is named as a config of Habitat is, or has one of ``keys``."""
    return lambda members, name: f".{infix}." in name or not members.keys().isdisjoint(keys)


def _magic(*beginnings: bytes) -> re.Pattern[bytes]:
    return re.compile(b"|".join(map(re.escape, beginnings)))


# --- the table --------------------------------------------------------------------------------------------------------
_SCENE = "open a scene that names it with h3data.open"
BUILT_IN = (
    Format(
        name="gfx_replay",
        title="a gfx-replay recording",
        # as habitat-sim writes it, after empty keyframes: long files are recognised without being read as a whole
        begins=re.compile(
            (
                r"""\s*\{\s*"keyframes"\s*:\s*\[\s*(?:\{\s*\}\s*,\s*)*"""
                rf"""(?:\]|\{{\s*\}}\s*\]|\{{\s*"(?:{"|".join(sorted(REPLAY_MEMBERS))})"\s*:)"""
            ).encode()
        ),
        members=_is_replay,
        suffixes=(".json", ".json.gz"),
    ),
    Format(
        # before its episode and before episode datasets: it has their members too
        name="hitl_session",
        title="a human-in-the-loop session (habitat-lab rearrange_v2)",
        members=_has("session", "users", "episodes"),
        hint="import the files beside it: each holds one of its episodes",
    ),
    Format(
        name="hitl_episode",
        title="an episode of a human-in-the-loop session (habitat-lab rearrange_v2)",
        members=_has("session", "episode", "frames"),
        suffixes=(".json", ".json.gz"),
    ),
    Format(
        name="hitl_log",
        title="a human-in-the-loop log of the first generation (habitat-lab rearrange)",
        members=lambda m, name: "steps" in m and not m.keys().isdisjoint(("episode_id", "scene_id", "start_time")),
        suffixes=(".pkl.gz", ".json", ".json.gz"),
    ),
    Format(
        name="rearrange_episodes",
        title="an episode dataset",
        members=_has("episodes"),
        hint="h3data info shows what it holds, h3data generate --episodes-file plays it",
    ),
    Format(
        name="scene_instance",
        title="a scene instance",
        members=lambda m, name: not m.keys().isdisjoint(("stage_instance", "object_instances")),
    ),
    Format(
        name="semantic_config",
        title="a semantic configuration",
        members=_has("region_annotations"),
        hint=_SCENE,
    ),
    Format(
        name="lighting_config",
        title="a lighting configuration",
        hint=_SCENE,
        members=lambda m, name: "lights" in m and "stages" not in m,
    ),
    Format(
        name="scene_filter",
        title="a receptacle filter",
        members=_has("active", "manually_filtered"),
        hint=_SCENE,
    ),
    Format(name="scene_dataset_config", title="a scene dataset configuration", members=_is_scene_dataset),
    Format(
        name="ao_config", title="an articulated object configuration", members=_config("ao_config", "urdf_filepath")
    ),
    Format(
        name="physics_config",
        title="a physics configuration",
        members=_config("physics_config", "physics_simulator"),
    ),
    Format(
        name="stage_config",
        title="a stage configuration",
        members=_config("stage_config", "gravity", "nav_asset", "semantic_asset"),
    ),
    Format(
        name="object_config",
        title="an object configuration",
        members=_config("object_config", "render_asset"),
    ),
    Format(
        name="pickle",
        title="a pickle",
        # protocols 3 to 5, those of Python 3
        begins=re.compile(b"\x80[\x03-\x05]"),
    ),
    Format(
        name="navmesh",
        title="a Habitat navmesh",
        begins=_magic(b"TESM"),
    ),
    Format(
        name="rosbag2",
        title="a bag of ROS 2",
        begins=re.compile(
            rb"\x89MCAP0\r\n\x01.{8}\x04\0\0\0ros2|SQLite format 3\0|\s*rosbag2_bagfile_information:", re.DOTALL
        ),
    ),
    # after rosbag2, whose bags are MCAP files that begin with the profile ros2
    Format(name="mcap", title="an MCAP log", begins=_magic(b"\x89MCAP0\r\n")),
    Format(
        name="parquet",
        title="a Parquet file",
        begins=_magic(b"PAR1"),
        hint="open the dataset folder that it belongs to",
    ),
    Format(name="arrow", title="an Arrow file", begins=_magic(b"ARROW1")),
    Format(name="rrd", title="a Rerun recording (.rrd)", begins=_magic(b"RRF")),
    Format(name="hdf5", title="an HDF5 file", begins=_magic(b"\x89HDF")),
    Format(name="glb", title="a glTF model (.glb)", begins=_magic(b"glTF")),
    Format(name="png", title="a PNG picture", begins=_magic(b"\x89PNG")),
    Format(name="jpeg", title="a JPEG picture", begins=_magic(b"\xff\xd8\xff")),
    Format(name="zip", title="a zip archive", begins=_magic(b"PK\x03\x04")),
    Format(name="numpy", title="a NumPy array", begins=_magic(b"\x93NUMPY")),
    Format(
        name="habitat_episodes",
        title="rearrangement episodes of Habitat, with their scenes",
    ),
)
TABLES = (
    Format(
        name="tracks",
        title="a table that may hold tracks of people",
        begins=re.compile(
            rb"""FILE_ID[,\t]|\s*\{\s*"(?:track|scene)"\s*:\s*\{\s*"(?:f|id|p)"\s*:"""  # THÖR-MAGNI, TrajNet++
            rb"""|(?:[#%][^\n]*\n)*[^\S\n]*[\w."'-][^\n,;\t{}<>\0]*(?:[,;\t][^\n,;\t{}<>\0]*){2,}(?:\n|$)"""  # CSV
            rb"""|(?:[#%][^\n]*\n)*[^\S\n]*(?:[+-]?[\d.]+(?:[eE][+-]?\d+)?(?:[ \t]+|(?=\r?\n|$))){4,}\r?(?:\n|$)"""  # numbers
        ),
    ),
)
"""Formats of text that plug-ins may recognize better, so that plug-ins are asked first."""
JSON = Format(name="json", title="JSON of an unknown kind")
UNKNOWN = Format(name="unknown", title="a file of an unknown kind")
