"""Homes in the files of other programs (`usd`, `procthor`), robots in MJCF (`mjcf`) or without settings (`robot_guess`)."""
