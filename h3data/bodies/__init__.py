"""Who moves: people (skeleton, skin, motion clips) and robots (URDF), their meshes and collision capsules."""

from h3data.bodies.humanoid import BodyCapsule, Humanoid, SkinnedMesh, load_humanoid
from h3data.bodies.motion import Clip
from h3data.bodies.skeleton import JOINT_INDEX, JOINT_NAMES

__all__ = ["JOINT_INDEX", "JOINT_NAMES", "BodyCapsule", "Clip", "Humanoid", "SkinnedMesh", "load_humanoid"]
