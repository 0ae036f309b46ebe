"""Metrics of robots among people, from recordings: the profiles ``field`` (one person) and ``social`` (any number of them).

The group ``h3data.profiles`` finds them, so that nothing else imports this package.
"""
