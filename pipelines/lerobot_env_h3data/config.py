"""Configuration ``--env.type=h3data`` of lerobot."""
# pyright: reportMissingImports=false

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from lerobot_env_h3data import ENV_ID
from lerobot_env_h3data.env import PIXELS, PREFIX, STATE, LeRobotEnv


@EnvConfig.register_subclass("h3data")
@dataclass
class H3DataEnvConfig(EnvConfig):
    """Configuration of an environment that shows a policy the observations of a dataset."""

    dataset: str | None = None
    """Folder of the dataset, written by ``h3data export --to lerobot``."""
    scenes: str | None = None
    """Homes of new episodes, with commas between: names such as h3-homes/test (default: those of the dataset)."""
    episodes: str = "sampled"
    """Kind of episodes. ``sampled``: new ones. ``recorded``: those of the dataset; seed k begins number k."""
    cameras: str | None = None
    """Cameras to show, with commas between (default: all of the dataset)."""
    max_steps: int | None = None
    """Length limit of an episode (default: that of the dataset's rules)."""
    light: str | None = None
    """Light of the pictures: baked or flat (default: that of the videos)."""
    record: str | None = None
    """Folder for recordings of the evaluated episodes."""
    render_mode: str = "rgb_array"

    def __post_init__(self) -> None:
        """Read the widths of states and actions, and the size of pictures, from the dataset.

        Raises:
            InputError: the dataset cannot be played.
        """
        if self.dataset is None:
            raise ValueError("--env.dataset is missing: the folder of a dataset that h3data export --to lerobot wrote.")
        env = LeRobotEnv(self.dataset, **self._options())
        self.task, self.fps = env.task, int(env.metadata["render_fps"])
        spaces: dict[str, Any] = vars(env.observation_space)["spaces"]
        shape = spaces[STATE].shape
        self.features = {
            "action": PolicyFeature(type=FeatureType.ACTION, shape=env.action_space.shape or ()),
            STATE: PolicyFeature(type=FeatureType.STATE, shape=shape),
        }
        self.features_map = {"action": "action", STATE: "observation.state"}
        for name, space in getattr(spaces.get(PIXELS), "spaces", {}).items():
            self.features[f"{PIXELS}/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=space.shape)
            self.features_map[f"{PIXELS}/{name}"] = f"{PREFIX}{name}"

    def _options(self) -> dict[str, Any]:
        listed = {"scenes": self.scenes, "cameras": self.cameras}
        options: dict[str, Any] = {name: text.split(",") for name, text in listed.items() if text is not None}
        if self.cameras == "":
            options["cameras"] = []
        return {
            **options,
            "episodes": self.episodes,
            "max_steps": self.max_steps,
            "light": self.light,
            "record": self.record,
        }

    @property
    def package_name(self) -> str:
        """Package that registers the environment."""
        return "lerobot_env_h3data"

    @property
    def gym_id(self) -> str:
        """Id of the environment in Gymnasium."""
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Return the arguments of `LeRobotEnv`."""
        return {"dataset": self.dataset, "render_mode": self.render_mode, **self._options()}
