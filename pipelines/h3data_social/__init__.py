"""Metrics of robots among people: the profiles ``field`` (one person) and ``social`` (any number of people).

The profiles are entry points of the group ``h3data.profiles``, so that no other package imports this one.
"""
