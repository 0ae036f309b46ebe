"""HTML report on datasets and recordings: reading, measuring, tables, charts and pictures."""
