"""Robots: their URDF files, settings, kinematics and trot."""
