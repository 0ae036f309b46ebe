"""Homes and robots in the files of other makers: USD, in and out (`usd`), and robots in MJCF (`mjcf`)."""
