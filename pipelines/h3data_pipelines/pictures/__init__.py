"""Commands that show recordings: pictures, videos, reports, Rerun files."""
