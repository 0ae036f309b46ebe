"""Stops that users write: any activity at any thing of a home, also captured motions (`h3data_motion.acts`)."""

from __future__ import annotations

from typing import Any

from h3data.bodies.people.gestures import GESTURES
from h3data.errors import InputError, suggest
from h3data_crowds.chores import CHORES, ChoreRoutine
from h3data_crowds.routines import ACTIVITIES, Stop


def stops_of(episode: Any, number: int, words: str = "") -> ChoreRoutine:
    """Return the routine of an agent that ``words`` describe: ``PLACE:ACTIVITY:SECONDS``, joined by ``+``.

    Raises:
        InputError: A word is not of this form, or names an activity that nobody knows.
    """
    scene, free, body, start = episode.scene, episode.free, episode.roster[number].body, episode.starts[number, :2]
    stops = []
    for word in words.split("+"):
        place, _, rest = word.partition(":")
        activity, _, seconds = rest.partition(":")
        known = (*body.acts, *dict.fromkeys((*ACTIVITIES, *GESTURES, *CHORES)))
        if activity not in known:
            raise InputError(
                f"{episode.roster[number].name} does not know the activity {activity!r} of {word!r}, which is "
                f"PLACE:ACTIVITY:SECONDS.{suggest(activity, known)} Hint: a motion file is named with the person: "
                "human:female_1+dance=dance.bvh.",
                code="H3-TASK-097",
            )
        try:
            stops.append(Stop(place, activity, float(seconds)))
        except ValueError:
            raise InputError(
                f"Expected the seconds of {word!r} as a number, got {seconds!r}.", code="H3-TASK-098"
            ) from None
    return ChoreRoutine(scene, free, tuple(stops), body, start=start, number=number)
