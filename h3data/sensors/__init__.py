"""Sensors, which compute the observations of agents, and base classes for custom sensors (h3data docs extending)."""

from __future__ import annotations

from sim_kinematic.sensing.camera_sensor import CameraSensor
from sim_kinematic.sensing.sensor import NoiseModel, facing, gps_compass, with_noise
from sim_kinematic.sensing.table import SENSORS, Sensor

__all__ = [
    "SENSORS",
    "CameraSensor",
    "NoiseModel",
    "Sensor",
    "facing",
    "gps_compass",
    "with_noise",
]
