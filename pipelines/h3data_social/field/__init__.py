"""Profile ``field``: metrics of papers on social navigation, for the nearest person."""

from h3data_social.field.profile import with_clearance

__all__ = ["with_clearance"]
