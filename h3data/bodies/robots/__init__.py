"""Robots: URDF, settings, kinematics, trot."""
