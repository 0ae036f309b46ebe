"""Exact collision of convex shapes, through FCL: contacts, depths and distances."""

from sim_kinematic.contact.agent_contact import AgentContacts
from sim_kinematic.contact.fcl_world import Contact, FclScene, MovingShapes, collide, contacts, distance
from sim_kinematic.contact.shapes import capsule_transforms, shapes_from_capsules

__all__ = [
    "AgentContacts",
    "Contact",
    "FclScene",
    "MovingShapes",
    "capsule_transforms",
    "collide",
    "contacts",
    "distance",
    "shapes_from_capsules",
]
