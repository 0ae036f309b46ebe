"""Interface of policies, which decide for an agent: their observations and their possible actions (h3data docs extending)."""

from __future__ import annotations

from sim_kinematic.agents.driven.commands import PersonCommand, Pick, Place
from sim_kinematic.agents.skills import LONGEST_MESSAGE, Action, Message
from sim_kinematic.policies.assignment import AssignedPolicy, PolicyChoice, PolicyMaker, policy_names, resolve_policy
from sim_kinematic.policies.learned import navigation_input
from sim_kinematic.policies.network import from_torch, save_network
from sim_kinematic.policies.policy import External, FunctionPolicy, Policy, Still, Velocity
from sim_kinematic.policies.views import AgentView, RearrangeView, SocialNavView

__all__ = [
    "LONGEST_MESSAGE",
    "Action",
    "AgentView",
    "AssignedPolicy",
    "External",
    "FunctionPolicy",
    "Message",
    "PersonCommand",
    "Pick",
    "Place",
    "Policy",
    "PolicyChoice",
    "PolicyMaker",
    "RearrangeView",
    "SocialNavView",
    "Still",
    "Velocity",
    "from_torch",
    "navigation_input",
    "policy_names",
    "resolve_policy",
    "save_network",
]
