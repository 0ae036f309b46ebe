"""Kinematic simulator: people and robots in homes, stepped 30 times a second (ARCHITECTURE.md)."""

import h3data  # noqa: F401 - from then on, imports of modules that have moved say where they are
