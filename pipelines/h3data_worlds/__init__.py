"""Homes in the files of other makers (`usd`, `procthor`), robots in MJCF (`mjcf`) or without settings (`robot_guess`)."""
