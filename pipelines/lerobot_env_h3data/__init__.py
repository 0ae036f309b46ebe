"""Environments of h3data for lerobot-eval, found by lerobot by the name of this package.

Importing it registers the Gymnasium id `ENV_ID` and, where lerobot is installed, the configuration ``--env.type=h3data``.
"""

from __future__ import annotations

import importlib.util

import gymnasium

ENV_ID = "h3data/LeRobot-v0"

if ENV_ID not in gymnasium.registry:
    # no wrapper of Gymnasium's around it: lerobot reads attributes such as task_description from the environment itself
    gymnasium.register(
        ENV_ID,
        entry_point="lerobot_env_h3data.env:LeRobotEnv",
        order_enforce=False,
        disable_env_checker=True,
    )

if importlib.util.find_spec("lerobot") is not None:
    importlib.import_module("lerobot_env_h3data.config")
