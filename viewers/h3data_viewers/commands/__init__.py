"""Commands that show recordings: ``h3data view`` and ``h3data report``."""
