"""The profile ``field``: what papers on social navigation report."""

from h3data_social.field.profile import with_clearance

__all__ = ["with_clearance"]
