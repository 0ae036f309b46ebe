"""Social navigation: a robot finds a person and follows them."""

from sim_kinematic.tasks.social_nav.task import PAPER_OBSERVATIONS, TRAINING, SocialNav

__all__ = ["PAPER_OBSERVATIONS", "TRAINING", "SocialNav"]
