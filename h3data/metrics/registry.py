"""Metric profiles by name, and the profile that measures a recording.

Included are `paper` (as published), `habitat` and `habitat@0.3.0` (as that code computes them), `field` (what papers on
social navigation report), `social` (the same among any number of people, as four sources define it), `partnr`,
`llm` (the cost of language models), and `task` (success, reward and time of any task). Installed packages add profiles by
entry points of the group ``h3data.profiles``; ``module:name`` needs no entry point. A name can stand for several profiles,
one per task.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from h3data.errors import H3DataError, InputError, UntrustedNameError, did_you_mean
from h3data.metrics.episode import EpisodeMetrics
from h3data.metrics.metric import Metric, Series
from h3data.metrics.profile import Profile
from h3data.plugins import Registry, names_from_data
from h3data.recording.records import Recording

ANY_TASK = "task"
"""Name of the profile for tasks that no other profile names."""


def _check(loaded: Any) -> None:
    several = loaded if isinstance(loaded, tuple) else (loaded,)
    if not several or not all(isinstance(profile, Profile) for profile in several):
        raise InputError(f"expected an h3data.metrics.Profile or a tuple of them, got {loaded!r}", code="H3-METRIC-025")


PROFILES: Registry[Profile | tuple[Profile, ...]] = Registry(
    "h3data.profiles",
    {
        "paper": "h3data.metrics.paper.profiles:PROFILES",
        "habitat": "",  # empty: of another of our packages
        "habitat@0.3.0": "",
        "field": "",
        "social": "",
        "partnr": "",  # of h3data_language
        "partnr@habitat": "",
        "llm": "",  # of h3data_llm
        ANY_TASK: "h3data.metrics.any_task:PROFILE",
    },
    what="metrics profile",
    check=_check,
)


@functools.cache  # entry points are files: looking them up again for each of 10,000 episodes would take a minute
def profiles_named(name: str) -> tuple[Profile, ...]:
    """Return the profiles with a name or ``module:name``, one per task.

    Raises:
        InputError: nothing has this name; the message lists the names.
        PluginError: the profile of another package cannot be used.
    """
    loaded = PROFILES.get(name)
    return loaded if isinstance(loaded, tuple) else (loaded,)


def all_profiles() -> tuple[Profile, ...]:
    """Return every profile that has a name: built-in ones first, then those of installed packages."""
    return tuple(
        profile
        for loaded in PROFILES.load_all().values()
        for profile in (loaded if isinstance(loaded, tuple) else (loaded,))
    )


def find_profile(name: str, task: str | None = None) -> Profile:
    """Return the profile with a name that measures recordings of a task; without a task, the first one with the name.

    Raises:
        InputError: nothing has this name, or it does not measure the task; the message lists the profiles that do.
        PluginError: the profile of another package cannot be used.
    """
    for profile in profiles_named(name):
        if task is None or profile.measures(task):
            return profile
    suitable = dict.fromkeys(profile.name for profile in all_profiles() if profile.measures(str(task)))
    raise InputError(
        f"Profile {name!r} does not measure the task {task!r}. Use one of: {', '.join(suitable)}.", code="H3-METRIC-023"
    )


def profile_for(task: str, info: Mapping[str, Any], name: str | None = None) -> Profile:
    """Return the profile that measures a recording: ``name``, else ``info["profile"]``, else the first that names its task.

    A task that no profile names gets the profile ``task``. ``info["profile"]`` may be ``module:name`` of a
    module that the user has trusted (`h3data.plugins.trust`, ``--trust``).

    Raises:
        InputError: nothing has this name, or it does not measure the task; the message states whether ``info`` gave the
            name.
        UntrustedNameError: ``info["profile"]`` refers to a module that the user has not trusted.
    """
    if name is not None:
        return find_profile(name, task)
    declared = info.get("profile")
    if not declared:
        return _profile_naming(task)
    try:
        with names_from_data():
            return find_profile(str(declared), task)
    except H3DataError as fault:
        # the name comes from a file, so the error names the file: its reader did not choose the name
        raise (UntrustedNameError if isinstance(fault, UntrustedNameError) else InputError)(
            f"Recordings of {task!r} ask for the metrics profile {declared!r}, which cannot be used: {fault} "
            f"Hint: choose another profile; {ANY_TASK} measures any task.",
            code=fault.code,
        ) from fault


@functools.cache
def _profile_naming(task: str) -> Profile:
    # the first ones first: to load all others takes longer than to measure an episode
    several = (functools.partial(profiles_named, next(iter(PROFILES.names()))), all_profiles)
    return next((p for profiles in several for p in profiles() if task in p.tasks), profiles_named(ANY_TASK)[0])


def metrics_of(profile: str, task: str | None = None) -> tuple[Metric, ...]:
    """Return all metrics of a profile for a task; None stands for the first task of the profile."""
    return find_profile(profile, task).metrics


def find_metric(name: str, *, profile: str | None = None) -> Metric:
    """Return the metric with this id or short name (``S``, ``paper/social_nav/S``, ``paper/social_nav/S@1``).

    If several profiles have a metric with a short name, it is searched in ``profile``, then in the other profiles in
    order.
    """
    preferred = [m for p in profiles_named(profile) for m in p.metrics] if profile is not None else []
    every = [*preferred, *(m for m in all_metrics() if m not in preferred)]
    tests = (
        lambda m: name in (m.id, m.id.rpartition("@")[0]),
        lambda m: name == m.name,
        lambda m: name.lower() == m.name.lower(),
    )
    # an exact id first, then an exact name: `s` is S only where nothing is called s
    for test in tests:
        for metric in every:
            if test(metric):
                return metric
    near = did_you_mean(name, [m.name for m in every] + [m.id.rpartition("@")[0] for m in every])
    raise InputError(f"No metric {name!r}.{near} `h3data metrics list` shows all.", code="H3-METRIC-024")


def all_metrics() -> list[Metric]:
    """Return every metric of every profile that has a name."""
    return [metric for profile in all_profiles() for metric in profile.metrics]


def measure(recording: Recording, profile: str | None = None) -> EpisodeMetrics:
    """Measure one recording by a profile, by default the profile of its task.

    Only columns are read; no simulator runs.

    Raises:
        InputError: there is no such profile, or it does not measure the recording's task.
        UnmeasurableError: the recording lacks agents that the profile needs, or data that every metric needs.
    """
    return profile_for(recording.episode.task, recording.episode.info, profile).measure(recording)


def series_of(recording: Recording, profile: str | None = None) -> Series:
    """Return the per-row quantities and flags [T] behind the metrics of a profile, by name."""
    return profile_for(recording.episode.task, recording.episode.info, profile).series(recording)
