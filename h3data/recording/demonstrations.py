"""File ``meta/h3data.json`` of demonstrations exported to LeRobot, by which an environment reproduces observations.

LeRobot's own metadata state the size of states and images. They do not state the meaning of the numbers in a state, the
field of view of a camera, the rules, or the homes. A policy with other observations than in training fails without a
message.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from h3data.errors import FormatError, InputError
from h3data.recording.parquet.files import write_atomic
from h3data.recording.storage import AnyPath

FILE = "meta/h3data.json"
VERSION = 1
"""Version of the file. Readers refuse a newer one."""


class DemonstratedCamera(msgspec.Struct, frozen=True, kw_only=True):
    """Camera with a video of every episode."""

    key: str
    """Name of the feature, such as ``observation.images.robot_arm``."""
    camera: str
    """Name of the camera on the body that carries it; the name of the feature if no body carries it."""
    agent: str
    """Name of the agent that carries the camera; empty if no agent does, so that an environment cannot render it."""
    width: int
    """Width of the rendered picture [px]. As videos have even widths, the last column of a video may be a copy."""
    height: int
    stored_width: int
    """Width of the video's frames [px]."""
    stored_height: int
    hfov_deg: float
    """Horizontal field of view [deg]."""


class DemonstratedAgent(msgspec.Struct, frozen=True, kw_only=True):
    """Agent of a dataset of demonstrations, as in its first episode."""

    name: str
    kind: str
    model: str
    policy: str = ""
    """Name of the policy that controlled the agent."""


class DemonstratedScene(msgspec.Struct, frozen=True, kw_only=True):
    """Home in which episodes took place."""

    name: str
    sha256: str
    episode: int
    """Number of the first episode in this scene, which holds the scene's file."""
    source: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Recipe of the scene, as in recordings."""


class Demonstrations(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of ``meta/h3data.json``."""

    version: int = VERSION
    created_by: str = ""
    task: str
    """Name of the task."""
    instruction: str = ""
    """Instruction of the task in words."""
    agent: str
    """Name of the agent whose actions are learned."""
    agents: tuple[DemonstratedAgent, ...]
    fps: int
    light: str
    """Light of the videos: ``baked`` or ``flat``."""
    state_key: str = "observation.state"
    state_columns: tuple[str, ...]
    """Columns of a recording whose concatenated values are the state."""
    state_names: tuple[str, ...]
    """Names of the numbers of a state."""
    action_key: str = "action"
    action_names: tuple[str, ...]
    success_events: tuple[str, ...]
    """Kinds of event that mean success. The first of them gives the reward 1, every other step 0."""
    cameras: tuple[DemonstratedCamera, ...] = ()
    scenes: tuple[DemonstratedScene, ...]
    seeds: tuple[int, ...]
    """Seed of each episode."""
    episode_scenes: tuple[int, ...]
    """Number of each episode's home in ``scenes``."""
    rules: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Rules of the first episode, as in recordings."""


def write_demonstrations(root: AnyPath, demonstrations: Demonstrations) -> None:
    """Write ``meta/h3data.json`` of a dataset."""
    write_atomic(root / FILE, msgspec.json.format(msgspec.json.encode(demonstrations), indent=1))


def read_demonstrations(root: AnyPath) -> Demonstrations:
    """Read ``meta/h3data.json`` of a dataset.

    Raises:
        InputError: the dataset has no such file.
        FormatError: the file is damaged, or written by a newer version of h3data.
    """
    path = root / FILE
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Demonstrations)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            f"The dataset has no {FILE}, which says what a policy was shown. Hint: export it again with h3data export --to "
            f"lerobot: {root}",
            code="H3-RECORDING-132",
        ) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FormatError(
            f"{FILE} is damaged ({str(error).replace('`', '')}): {root}", code="H3-RECORDING-133"
        ) from None
    # fields may be added without a new version: msgspec passes over those that it does not know
    if found.version > VERSION:
        raise FormatError(
            f"{FILE} has version {found.version}, this h3data reads up to {VERSION}. Hint: install a newer one: {root}",
            code="H3-RECORDING-130",
        )
    if len(found.seeds) != len(found.episode_scenes) or not all(
        0 <= k < len(found.scenes) for k in found.episode_scenes
    ):
        raise FormatError(
            f"{FILE} is damaged (seeds and scenes of the episodes do not fit): {root}", code="H3-RECORDING-131"
        )
    return found
