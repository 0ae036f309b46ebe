"""Homes in the files of other makers: USD, in and out (`usd`)."""
