"""Bodies of agents: people (skeleton, skin, motion clips) and robots (URDF), with meshes and collision shapes."""

from h3data.bodies.names import load_humanoid
from h3data.bodies.people.clips import Clip
from h3data.bodies.people.humanoid import BodyCapsule, Humanoid, SkinnedMesh
from h3data.bodies.people.humanoid_file import humanoid_names
from h3data.bodies.people.skeleton import JOINT_INDEX, JOINT_NAMES
from h3data.bodies.robots.ik import IkResult, solve_ik
from h3data.bodies.robots.robot import JointTargets, Robot, RobotCamera, RobotLeg, RobotLink
from h3data.bodies.robots.robot_files import is_robot, is_robot_file, robot_names
from h3data.bodies.robots.robot_loading import check_robot, guess_robot_settings, load_robot, robot_digest, robot_name
from h3data.bodies.robots.urdf import Urdf, read_urdf

__all__ = [
    "JOINT_INDEX",
    "JOINT_NAMES",
    "BodyCapsule",
    "Clip",
    "Humanoid",
    "IkResult",
    "JointTargets",
    "Robot",
    "RobotCamera",
    "RobotLeg",
    "RobotLink",
    "SkinnedMesh",
    "Urdf",
    "check_robot",
    "guess_robot_settings",
    "humanoid_names",
    "is_robot",
    "is_robot_file",
    "load_humanoid",
    "load_robot",
    "read_urdf",
    "robot_digest",
    "robot_name",
    "robot_names",
    "solve_ik",
]
