"""Profile ``field``: metrics of papers on social navigation."""

from h3data_social.field.profile import with_clearance

__all__ = ["with_clearance"]
