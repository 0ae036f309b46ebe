"""Profile ``social``: metrics of social navigation over every person of an episode, of many episodes at once.

Definitions and sources: `h3data_social.people.definitions`. Rows without a pose are ignored. Metrics that a recording
does not determine are NaN, with a note.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_from_quat, wrap_angle
from h3data.metrics.episode import Notes
from h3data.metrics.metric import NAN, Series
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.report_layout import Milestone, ReportLayout
from h3data.metrics.requirements import find_agents, note_missing
from h3data.recording.records import Recording
from h3data_social.field.definitions import (
    COMPLIANT_M,
    FULL_SPEED_M_S,
    HUMAN_RADIUS_M,
    INTIMATE_M,
    PERSONAL_M,
    ROBOT_RADIUS_M,
    STALLED_M_S,
    STALLED_RAD_S,
)
from h3data_social.field.goal import Goal, find_goal
from h3data_social.field.profile import CLEARANCE, nearest_of, time_to_collision, weighted, zones
from h3data_social.others import find_others
from h3data_social.people.definitions import (
    FORCE,
    GAMMA,
    LAMBDA,
    MET_M,
    N_PRIME,
    P_SPACE_M,
    PROGRESS_M,
    PROGRESS_S,
    RATE_HZ,
    SOCIAL_METRICS,
    SPACE_M,
    TARGET_M,
    N,
)
from h3data_social.people.rows import Array, Rows

PEOPLE, ROBOTS, ANYBODY = "metrics.collision_people", "metrics.collision_robots", "metrics.collision"
SLIDING = "metrics.robot_contact"
_PERIOD_NS = 1_000_000_000 // RATE_HZ
Flags = NDArray[np.bool_]


def compute_social(recordings: Sequence[Recording], notes: Sequence[Notes]) -> list[Computed]:
    """Compute all metrics of the first robot near all people of each recording.

    `Computed.human` is the person who comes nearest to the robot; the robot itself where it is alone.
    """
    for recording, note in zip(recordings, notes, strict=True):
        _require_robot(recording)  # before anything is computed
        note_missing(SOCIAL_METRICS, recording, note)
    some = [k for k, recording in enumerate(recordings) if len(recording)]
    crowd = _Crowd.of([recordings[k] for k in some]) if some else None
    values = _values(crowd) if crowd else {}
    moved = crowd.speed * crowd.seconds if crowd else np.zeros(0)
    computed = []
    for k, (recording, note) in enumerate(zip(recordings, notes, strict=True)):
        robot, people = find_others(recording)
        if not len(recording):
            note.add((m.name for m in SOCIAL_METRICS), "the recording has no rows")
            computed.append(Computed(values={}, robot=robot, human=(*people, robot)[0]))
            continue
        assert crowd
        e = some.index(k) if len(some) < len(recordings) else k
        goal, contacts = crowd.goals[e], crowd.contacts[e]
        own = {name: float(each[e]) for name, each in values.items()}
        _note(goal, contacts, note)
        own |= _of_contacts(contacts) | _of_groups(recording, robot)
        own |= _of_goal(goal, contacts, own, recording, moved[crowd.rows.starts[e] : crowd.rows.ends[e]])
        for metric in SOCIAL_METRICS:
            if np.isnan(own.get(metric.name, NAN)) and metric.name not in note.lines:
                note.add([metric.name], metric.undefined[:1].lower() + metric.undefined[1:].rstrip("."))
        first = int(np.argmax(contacts.touched)) if contacts.touched is not None and contacts.touched.any() else -1
        moments = {name: row for name, row in (("goal", goal.row), ("collision", first)) if row >= 0}
        if goal.agent >= 0 and goal.row >= 0:
            moments["found"] = goal.row
        computed.append(
            Computed(values=own, robot=robot, human=(*people, robot)[crowd.nearest_person(e)], moments=moments)
        )
    return computed


def social_series(recording: Recording) -> Series:
    """Compute the per-row quantities and flags [T]. Motion in row k is since row k - 1, and NaN in row 0."""
    _require_robot(recording)
    crowd = _Crowd.of([recording])
    series = {
        "dist_m": crowd.nearest,
        "goal_distance_m": crowd.goals[0].distance,
        "speed_m_s": crowd.speed,
        "ttc_s": np.fmin.reduce(crowd.times_to_collision(), axis=1),
        "personal_space": crowd.nearest >= COMPLIANT_M,
        **zones(crowd.nearest),
        "stalled": crowd.stalled,
        "stuck": crowd.stuck(),
        "goal": crowd.goals[0].reached,
    }
    contacts = crowd.contacts[0]
    gaps, radii = _group_gaps(recording, find_others(recording)[0])
    series["o_space"] = np.asarray((gaps < radii).any(axis=1))
    flags = {"collision": contacts.touched, "wall_contact": _rows_of(contacts.walls)}
    return series | {name: held for name, held in flags.items() if held is not None}


def _require_robot(recording: Recording) -> None:
    """Raise an `UnmeasurableError` unless there is a robot with people, or alone."""
    if find_others(recording)[1]:
        find_agents(recording)


@dataclass(frozen=True)
class _Contacts:
    """People whom the robot of an episode touches; None if it was not recorded."""

    people: Flags | None
    """Contact with each person, [T, P]."""
    robots: Flags | None
    """Contact with each other robot, [T, number of other robots]."""
    walls: Flags | None
    """Contact with walls, [T, 1]."""
    note: str = ""

    @property
    def touched(self) -> Flags | None:
        """Rows in which the robot touches a person [T]."""
        return _rows_of(self.people)

    @classmethod
    def of(cls, recording: Recording) -> _Contacts:
        """Return the contacts of the first robot of a recording, as far as its columns tell them."""
        _, people = find_others(recording)
        columns, rows, agents = recording.columns, len(recording), len(recording.agents)
        others = agents - len(people) - 1
        anybody = _flags(columns[ANYBODY]) if ANYBODY in columns else None
        walls = _flags(columns[SLIDING]) if SLIDING in columns else None
        touched = _flags(columns[PEOPLE]) if PEOPLE in columns else None
        note = ""
        if not people:
            touched = np.zeros((rows, 0), np.bool_)
        elif touched is not None and touched.shape[1] != len(people):
            note = f"column {PEOPLE} is of {touched.shape[1]} people; there are {len(people)}"
            touched = None
        elif touched is None and anybody is not None:
            if agents == 2:
                touched = anybody
            elif not anybody.any():
                touched = np.zeros((rows, len(people)), np.bool_)
            else:
                note = (
                    f"column {ANYBODY} does not say who of {agents} agents touch each other, and there is no {PEOPLE}"
                )
        robots = _flags(columns[ROBOTS]) if ROBOTS in columns else None
        if not others or (robots is None and anybody is not None and not anybody.any()):
            robots = np.zeros((rows, others), np.bool_)
        return cls(people=touched, robots=robots, walls=walls, note=note)

    def until(self, row: int, *, everything: bool) -> bool | None:
        """Return whether the robot touches a person, or with ``everything`` anything, up to a row; None if unknown."""
        kinds = [self.people, self.robots, self.walls] if everything else [self.people]
        if any(flags is not None and flags[: row + 1].any() for flags in kinds):
            return True
        return None if any(flags is None for flags in kinds) else False


def _flags(column: NDArray) -> Flags:
    # Not astype(bool): imported columns are floats with NaN where nothing was logged.
    return np.asarray(column.reshape(len(column), -1) > 0)


def _rows_of(flags: Flags | None) -> Flags | None:
    return None if flags is None else np.asarray(flags.any(axis=1))


@dataclass(frozen=True, kw_only=True)
class _Crowd:
    """Robots and people of several episodes, R rows one after another, with P people each, NaN where there are fewer."""

    recordings: Sequence[Recording]
    rows: Rows
    time_ns: NDArray[np.int64]
    seconds: Array
    """Time since the previous row [R]; NaN in the first of an episode."""
    at: Array
    """Places of robots on the floor [R, 2] [m]."""
    turn: Array
    """Absolute changes of the robots' heading [R] [rad]."""
    people: Array
    """Places of people on the floor [R, P, 2] [m]."""
    gaps: Array
    """Distances from the robot to each person [R, P] [m]."""
    nearest: Array
    """Smallest distance from the robot to a person [R] [m]."""
    speed: Array
    """Speed of the robot since the previous row, shape [R] [m/s]."""
    goals: Sequence[Goal]
    contacts: Sequence[_Contacts]

    @classmethod
    def of(cls, recordings: Sequence[Recording]) -> _Crowd:
        """Return the crowd of recordings that have rows, a robot and people."""
        found = [find_others(recording) for recording in recordings]
        # a robot alone has one person, who is nowhere
        most = max(1, *(len(people) for _, people in found))
        rows = Rows.of([len(recording) for recording in recordings])
        pose = np.concatenate(
            [
                recording.agent_column(robot, "base_pose")
                for recording, (robot, _) in zip(recordings, found, strict=True)
            ]
        ).astype(np.float64)
        places = np.full((rows.total, most, 2), np.nan)
        for start, recording, (_, people) in zip(rows.starts.tolist(), recordings, found, strict=True):
            for p, number in enumerate(people):
                places[start : start + len(recording), p] = recording.agent_column(number, "base_pose")[:, [0, 2]]
        at = pose[:, [0, 2]]
        time_ns = np.concatenate([recording.columns["time_ns"] for recording in recordings])
        seconds = rows.changes(time_ns) * 1e-9
        gaps = np.linalg.norm(places - at[:, None], axis=2)
        return cls(
            recordings=recordings,
            rows=rows,
            time_ns=time_ns,
            seconds=seconds,
            at=at,
            turn=np.abs(wrap_angle(rows.changes(heading_from_quat(pose[:, 3:]).reshape(-1)))),
            people=places,
            gaps=gaps,
            nearest=np.fmin.reduce(gaps, axis=1),
            speed=np.linalg.norm(rows.changes(at), axis=1) / seconds,
            goals=[find_goal(recording) for recording in recordings],
            contacts=[_Contacts.of(recording) for recording in recordings],
        )

    @property
    def stalled(self) -> Flags:
        """Rows in which the robot neither drives nor turns [R]."""
        return (self.speed < STALLED_M_S) & (self.turn / self.seconds < STALLED_RAD_S)

    def nearest_person(self, episode: int) -> int:
        """Return the column of the person whom the robot of an episode comes nearest; 0 if unknown."""
        rows = slice(self.rows.starts[episode], self.rows.ends[episode])
        return nearest_of(self.gaps[rows])

    def times_to_collision(self) -> Array:
        """Return the time until the discs of robot and person touch at their last velocities [R, P] [s]."""
        towards = self.people - self.at[:, None]
        velocity = self.rows.changes(towards) / self.seconds[:, None, None]
        return time_to_collision(towards, velocity, ROBOT_RADIUS_M + HUMAN_RADIUS_M)

    def closing(self) -> tuple[Flags, Flags]:
        """Return whether in each row the robot, or else the person, closes the gap between them, each [R, P]."""
        before, length = np.full(self.people.shape, np.nan), np.full(self.gaps.shape, np.nan)
        before[1:], length[1:] = (self.people - self.at[:, None])[:-1], self.gaps[:-1]
        robot = np.sum(self.rows.changes(self.at)[:, None] * before, axis=2)
        person = -np.sum(self.rows.changes(self.people) * before, axis=2)
        return (robot >= person) & (length > 0), (robot < person) & (length > 0)

    def stuck(self) -> Flags:
        """Return rows [R] before arrival in which the goal came less than `PROGRESS_M` nearer within `PROGRESS_S`."""
        distance = np.concatenate([goal.distance for goal in self.goals])
        before = self.rows.earlier(self.time_ns, int(PROGRESS_S * 1e9))
        with np.errstate(invalid="ignore"):
            stuck = (before >= 0) & (distance[before] - distance < PROGRESS_M)
        for start, end, goal in zip(self.rows.starts.tolist(), self.rows.ends.tolist(), self.goals, strict=True):
            if goal.row >= 0:
                stuck[start + goal.row : end] = False
        return stuck

    def touching(self) -> tuple[Flags, Flags]:
        """Return whether the robot touches each person [R, P], and whether an episode's contacts are known [E]."""
        flags, known = np.zeros(self.gaps.shape, np.bool_), np.zeros(len(self.contacts), np.bool_)
        for e, (start, contact) in enumerate(zip(self.rows.starts.tolist(), self.contacts, strict=True)):
            if contact.people is not None:
                flags[start : start + len(contact.people), : contact.people.shape[1]] = contact.people
                known[e] = True
        return flags, known


def _values(crowd: _Crowd) -> dict[str, Array]:
    """Return metrics that need no goal [E] by name."""
    return _space(crowd) | _rowwise(crowd) | _sampled(crowd)


def _space(crowd: _Crowd) -> dict[str, Array]:
    rows, nearest = crowd.rows, crowd.nearest
    outside = np.maximum(nearest - ROBOT_RADIUS_M, 0.0)
    outline = np.maximum(nearest - ROBOT_RADIUS_M - HUMAN_RADIUS_M, 0.0)
    with np.errstate(invalid="ignore"):
        seen = np.where((known := rows.sum(~np.isnan(nearest))) > 0, known, np.nan)
    shares = {"PSC": nearest >= COMPLIANT_M, "SC": outline >= SPACE_M, "SC_centre": nearest >= SPACE_M}
    shares |= {f"Z_{zone}": flags for zone, flags in zones(nearest).items()}
    shares |= {f"Z_{zone}_outline": flags for zone, flags in zones(nearest - ROBOT_RADIUS_M).items()}
    values = {name: rows.sum(flags) / seen for name, flags in shares.items()}
    values["DH_min"] = values["CP_min"] = rows.least(nearest)
    values["DH_min_outline"], values["CP_min_outline"] = rows.least(outline), rows.least(outside)
    values["CP_avg"], values["CP_avg_outline"] = rows.mean(nearest), rows.mean(outline)
    values["CP_max"] = rows.greatest(nearest)
    values["CP_max_outline"] = np.maximum(rows.greatest(np.fmax.reduce(crowd.gaps, axis=1)) - ROBOT_RADIUS_M, 0.0)
    by_robot, by_person = crowd.closing()
    for zone, limit in (("personal", PERSONAL_M), ("intimate", INTIMATE_M)):
        begins = rows.begins(crowd.gaps < limit)
        values[f"RP_{zone}"] = np.where(known > 0, rows.sum(begins & by_robot), np.nan)
        values[f"PR_{zone}"] = np.where(known > 0, rows.sum(begins & by_person), np.nan)
    touching, told = crowd.touching()
    begins = rows.begins(touching)
    values["RPC"] = np.where(told, rows.sum(begins & by_robot), np.nan)
    values["PRC"] = np.where(told, rows.sum(begins & by_person), np.nan)
    times = np.fmin.reduce(crowd.times_to_collision(), axis=1)
    values["TTC_min"] = rows.least(np.where(np.isfinite(times), times, np.nan))
    return values


def _rowwise(crowd: _Crowd) -> dict[str, Array]:
    """Return metrics of the robot's own rows."""
    rows = crowd.rows
    moves = rows.sum(~np.isnan(crowd.speed)) > 0
    somewhere = rows.sum(~np.isnan(crowd.at[:, 0])) > 0
    clear = [recording.columns.get(CLEARANCE) for recording in crowd.recordings]
    clearance = np.concatenate(
        [np.full(n, np.nan) if each is None else each for n, each in zip(rows.counts.tolist(), clear, strict=True)]
    ).astype(np.float64)
    return {
        "PL": np.where(somewhere, rows.sum(crowd.speed * crowd.seconds), np.nan),
        "ST": np.where(moves, rows.sum(np.where(crowd.stalled, crowd.seconds, 0.0)), np.nan),
        "CHC": np.where(moves, rows.sum(crowd.turn), np.nan),
        "FP": np.where([goal.first >= 0 for goal in crowd.goals], rows.sum(rows.begins(crowd.stuck())), np.nan),
        "CD_min": rows.least(clearance),
        "CD_mean": rows.mean(clearance),
    }


def _sampled(crowd: _Crowd) -> dict[str, Array]:
    """Return metrics of motion at `RATE_HZ`."""
    period = np.array([max(_PERIOD_NS, recording.episode.dt_ns) for recording in crowd.recordings], np.int64)
    samples, (at, people) = crowd.rows.sampled(crowd.time_ns, period, crowd.at, crowd.people)
    seconds = np.repeat(period * 1e-9, samples.counts)
    velocity = samples.changes(at) / seconds[:, None]
    acceleration = samples.changes(velocity) / seconds[:, None]
    jerk = samples.changes(acceleration) / seconds[:, None]
    values = {}
    for letter, vectors in (("V", velocity), ("A", acceleration), ("J", jerk)):
        sizes = np.linalg.norm(vectors, axis=1)
        values |= {f"{letter}_min": samples.least(sizes), f"{letter}_max": samples.greatest(sizes)}
        values[f"{letter}_mean"] = samples.mean(sizes)
    walking = samples.changes(people) / seconds[:, None, None]
    paces = np.linalg.norm(walking, axis=2)
    towards = people - at[:, None]
    gaps = np.linalg.norm(towards, axis=2)
    closest = np.where(np.isnan(gaps), np.inf, gaps).argmin(axis=1)
    force = social_force(towards, velocity[:, None] - walking)
    felt = ~np.isnan(force).all(axis=1)
    values["V_people"] = samples.mean(paces)
    values["V_nearest"] = samples.mean(np.take_along_axis(paces, closest[:, None], axis=1)[:, 0])
    values["SF"] = samples.mean(np.where(felt, np.nansum(force, axis=1), np.nan))
    return values


def social_force(towards: Array, velocity: Array) -> Array:
    """Return the magnitude of the social force between two agents [...] [m/s2] with HuNavSim's parameters.

    Args:
        towards: Offset from the first agent to the second on the floor [..., 2] [m].
        velocity: Velocity of the first agent relative to the second [..., 2] [m/s].
    """
    gap = np.linalg.norm(towards, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        e = towards / gap[..., None]
        drive = LAMBDA * velocity + e
        reach = GAMMA * np.linalg.norm(drive, axis=-1)
        angle = np.arctan2(e[..., 0] * drive[..., 1] - e[..., 1] * drive[..., 0], np.sum(e * drive, axis=-1))
        along = np.exp(-gap / reach - (N_PRIME * reach * angle) ** 2)
        aside = np.where(angle == 0, 0.0, np.exp(-gap / reach - (N * reach * angle) ** 2))
    return FORCE * np.hypot(along, aside)


def _note(goal: Goal, contacts: _Contacts, notes: Notes) -> None:
    of_goal = [m.name for m in SOCIAL_METRICS if "goal" in m.series or "goal_distance_m" in m.series]
    if goal.missing:
        notes.add(of_goal, goal.missing)
    for text in goal.notes:
        notes.add(
            ("SPL", "STL", "T", "path_ratio", "FP") if "straight" in text else ("S", "SR", "SPL", "STL", "T"), text
        )
    if contacts.note:
        notes.add(("S", "SR", "H_coll", "C", "HC", "HC_steps", "RPC", "PRC", "SPL", "STL", "total"), contacts.note)
    if contacts.robots is None:
        notes.add(("S", "C", "AC"), f"there are other robots, and no column {ROBOTS}")


def _group_gaps(recording: Recording, robot: int) -> tuple[Array, Array]:
    """Return distances of the robot to the centres of groups, inf before they meet, and their radii, [T, G] [m]."""
    told, names = recording.episode.info.get("people"), [agent.name for agent in recording.agents]
    groups: dict[str, list[int]] = {}
    for name, facts in told.items() if isinstance(told, dict) else ():
        word = facts.get("group") if isinstance(facts, dict) else None
        if isinstance(word, str) and word and name in names:
            groups.setdefault(word, []).append(names.index(name))
    at = recording.agent_column(robot, "base_pose")[:, [0, 2]].astype(np.float64)
    gaps, radii = [np.zeros((0, len(at)))], [np.zeros((0, len(at)))]
    for members in groups.values():
        if len(members) > 1:
            places = np.stack([recording.agent_column(k, "base_pose")[:, [0, 2]] for k in members], 1).astype(
                np.float64
            )
            centre = places.mean(1)
            out = np.linalg.norm(places - centre[:, None], axis=2)
            met = out.max(1) <= MET_M
            gaps.append(np.where(met, np.linalg.norm(at - centre, axis=1), np.inf)[None])
            radii.append(out.mean(1)[None])
    return np.concatenate(gaps).T, np.concatenate(radii).T


def _of_groups(recording: Recording, robot: int) -> dict[str, float]:
    """Return metrics of groups; none if no person walks or talks in a group."""
    gaps, radii = _group_gaps(recording, robot)
    seen = np.asarray(~np.isnan(gaps).all(axis=1))
    if not gaps.shape[1] or not seen.any():
        return {}
    inside = np.asarray((gaps < radii).any(axis=1))
    ring = ((gaps >= radii) & (gaps < radii + P_SPACE_M)).any(axis=1) & ~inside
    flags = {"G_o": inside, "G_p": ring}
    flags |= {f"IG_{zone}": held for zone, held in zones(np.fmin.reduce(gaps, axis=1)).items() if zone != "public"}
    return {"GCR": float(inside.any())} | {name: float(held[seen].mean()) for name, held in flags.items()}


def _of_contacts(contacts: _Contacts) -> dict[str, float]:
    """Return the counts of contacts; NaN if no contacts were recorded."""

    def count(flags: Flags | None) -> float:
        if flags is None:
            return NAN
        return float(np.count_nonzero(flags & ~np.concatenate([np.zeros_like(flags[:1]), flags[:-1]])))

    walls, robots, people = count(contacts.walls), count(contacts.robots), count(contacts.people)
    touched = contacts.touched
    steps = NAN if touched is None else float(touched.sum())
    any_contact = NAN if np.isnan(people) else float(people > 0)
    return {
        "H_coll": any_contact,
        "C": walls + robots + people,
        "WC": walls,
        "AC": robots,
        "HC": people,
        "HC_steps": steps,
    }


def _of_goal(
    goal: Goal, contacts: _Contacts, own: dict[str, float], recording: Recording, moved: Array
) -> dict[str, float]:
    """Return metrics of reaching the goal; undefined ones are left out. ``moved`` is the way since the row before [T] [m]."""
    if goal.first < 0:
        return {}
    row, times, info = goal.row, recording.columns["time_ns"], recording.episode.info
    straight = goal.straight[~np.isnan(goal.straight)]
    last = float(goal.straight[-1])
    values = {"TD_min": float(straight.min()), "TD_final": last}
    if not np.isnan(last):
        values["completed"] = float(last < TARGET_M)
    ended, limit = info.get("ended"), info.get("max_steps")
    if ended is not None or type(limit) is int:
        over = ended == "max_steps" if ended is not None else len(recording) >= (limit or 0)
        values["TO"] = float(row < 0 and over)
    if np.isfinite(goal.shortest) and goal.shortest > 0:
        values["path_ratio"] = own["PL"] / goal.shortest
    for name, everything in (("S", True), ("SR", False)):
        touched = contacts.until(row, everything=everything) if row >= 0 else True
        if touched is not None:
            values[name] = float(row >= 0 and not touched)
    if row >= 0:
        values["T"] = float(times[row] - times[0]) * 1e-9
    if values.get("SR") == 0:
        values |= {"SPL": 0.0, "STL": 0.0}
    elif "SR" in values and np.isfinite(goal.shortest):
        driven = float(np.nansum(moved[: row + 1]))
        values |= {"SPL": weighted(goal.shortest, driven)}
        values |= {"STL": weighted(goal.shortest / FULL_SPEED_M_S, values["T"])}
    if "SPL" in values:
        values["total"] = 0.4 * values["SR"] + 0.3 * values["SPL"] + 0.3 * own["PSC"]
    return values


PROFILE = Profile(
    name="social",
    title="social navigation among any number of people: Francis et al., HuNavSim, Falcon, SEAN",
    metrics=SOCIAL_METRICS,
    compute_many=compute_social,
    series=social_series,
    report=ReportLayout(
        title="Social navigation among people",
        columns=(
            "SR",
            "SPL",
            "STL",
            "H_coll",
            "PSC",
            "DH_min",
            "TTC_min",
            "RP_personal",
            "PR_personal",
            "Z_intimate",
            "GCR",
            "V_mean",
            "A_mean",
            "J_mean",
            "ST",
        ),
        findings={
            "SR": "reaches its goal without touching anybody in",
            "PSC": "keeps personal space for this share of the time:",
            "DH_min": "comes as near as [m]",
        },
        ranking=("SR", "SPL", "PSC"),
        by_partner=("SR", "H_coll", "PSC"),
        milestones=(
            Milestone(flag="goal", title="Goal reached by then", label="reaches the goal", metric="SR"),
            Milestone(flag="collision", title="Person touched by then", label="first contact", metric="H_coll"),
        ),
    ),
)
