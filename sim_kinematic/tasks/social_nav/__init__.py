"""Social navigation: a robot finds a person and follows them."""

from sim_kinematic.sensing.table import PAPER_OBSERVATIONS
from sim_kinematic.tasks.social_nav.task import TRAINING, SocialNav

__all__ = ["PAPER_OBSERVATIONS", "TRAINING", "SocialNav"]
