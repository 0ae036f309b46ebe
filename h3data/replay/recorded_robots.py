"""Checks that the files of a recording's robots have not changed."""

from __future__ import annotations

from collections.abc import Mapping

from h3data.bodies import check_robot
from h3data.errors import FormatError
from h3data.recording import Recording


def check_recorded_robots(recording: Recording) -> None:
    """Check that the robots of a recording still have the digests in ``info.robots_sha256``.

    Raises:
        InputError: The files of a robot are missing or have changed.
        FormatError: The digests are malformed.
    """
    digests = recording.episode.info.get("robots_sha256", {})
    if not isinstance(digests, Mapping) or not all(isinstance(digest, str) for digest in digests.values()):
        raise FormatError(
            f"Expected info.robots_sha256 to map robots to SHA-256 digests, got {digests!r}.", code="H3-REPLAY-028"
        )
    for agent in recording.agents:
        kind, _, name = agent.model.partition("/")
        if kind == "robot":
            check_robot(name, digests.get(name, ""), agent=agent.name)
