"""Profile ``paper``: the published metrics of social navigation and of social rearrangement, and their report."""

from __future__ import annotations

from h3data.metrics.paper.published import published_results
from h3data.metrics.paper.rearrangement import REARRANGEMENT, compute_rearrangement, rearrangement_series
from h3data.metrics.paper.social_nav import compute_social_nav, social_nav_series
from h3data.metrics.paper.social_nav_definitions import SOCIAL_NAV
from h3data.metrics.profile import GFX_REPLAY, Profile
from h3data.metrics.report_layout import Milestone, ReportLayout, StudyLayout

_TOUCHED = Milestone(flag="collision", title="Person touched by then", label="first contact", metric="CR")

SOCIAL_NAV_PROFILE = Profile(
    name="paper",
    title="Habitat 3.0 as published: social navigation",
    tasks=("social_nav", GFX_REPLAY),
    metrics=SOCIAL_NAV,
    compute_many=compute_social_nav,
    series=social_nav_series,
    report=ReportLayout(
        title="Social navigation",
        findings={"S": "finds the person in", "F": "follows at a rate F of", "CR": "touches the person in"},
        ranking=("F", "SPS", "S"),
        by_partner=("S", "F", "CR"),
        milestones=(
            Milestone(flag="found", title="Person found by then", label="finds the person", metric="S"),
            _TOUCHED,
        ),
        distance_zone_m=(1.0, 2.0),
        published=lambda: published_results().social_nav,
    ),
)

REARRANGEMENT_PROFILE = Profile(
    name="paper",
    title="Habitat 3.0 as published: social rearrangement",
    tasks=("rearrange", "social_rearrange", "rearrangement", "hitl_rearrange"),
    metrics=REARRANGEMENT,
    compute=compute_rearrangement,
    series=rearrangement_series,
    report=ReportLayout(
        title="Social rearrangement",
        columns=("SR", "RE", "CR", "RC"),
        percent=("SR",),
        findings={
            "SR": "completes the task in",
            "RE": "has a relative efficiency of",
            "CR": "touches the person in",
        },
        ranking=("SR", "RE", "TS"),
        by_partner=("SR", "RE", "CR", "RC"),
        milestones=(
            Milestone(flag="done", title="Task done by then", label="completes the task", metric="SR"),
            _TOUCHED,
        ),
        published=lambda: published_results().rearrange,
        study=StudyLayout(
            columns=("CR", "TS", "RC", "RE"),
            steps="TS",
            efficiency="RE",
            published=lambda: published_results().hitl,
            published_contrasts=lambda: published_results().contrasts,
        ),
    ),
)

PROFILES = (SOCIAL_NAV_PROFILE, REARRANGEMENT_PROFILE)
