"""Turn of an agent, with its choice, its motion, and the objects that it picks or places.

Its rules are `sim_kinematic.agents.oracle.rules`; the rest is equivalent to `sim_kinematic.agents.oracle.actors`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from h3data.bodies import Humanoid, Robot
from h3data_training.torch.rearrange.state import ABORTED, DONE, FAILED, FREE, NOBODY, RUNNING, Hands, SubGoal
from h3data_training.torch.rearrange.tables import Places
from h3data_training.torch.state import HumanTensors, RobotTensors
from h3data_training.torch.step import Grids, drive_robots, walk_humans, wrap_angle
from sim_kinematic.agents.oracle.actors import carry_point
from sim_kinematic.agents.oracle.rules import AIMED_RAD, VIA_M, gets_on, is_there, left_to_do, reaches
from sim_kinematic.agents.robots.driving import FACING_RAD, STUCK_STEPS
from sim_kinematic.agents.skills import CHOICE_WAIT_STEPS, PRIMITIVES
from sim_kinematic.motion.spec import STEP_S, BaseSpec, OracleSpec, WalkerSpec
from sim_kinematic.motion.state import HUMAN, ROBOT

NAV_OBJECT, NAV_GOAL, PICK, PLACE, WAIT = range(5)
"""Kinds of choices, which are followed by the primitives."""
NAV_HANDLE, OPEN, CLOSE = range(WAIT + 1 + len(PRIMITIVES), WAIT + 4 + len(PRIMITIVES))
"""Kinds of choices with a door or a drawer, of `sim_kinematic.agents.skills.OPENING_SKILLS`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choices:
    """Choices of one kind of agent (`sim_kinematic.agents.skills.choices`), as tables by number, [C] each."""

    who: int
    """Index of the agent: 0 for the robot, 1 for the person."""
    kind: Tensor
    target: Tensor
    """Number of the choice's object; 0 if it has none."""
    part: Tensor
    """Number of the choice's door or drawer; 0 if it has none."""
    steps: Tensor
    """Duration of each choice in steps; 0 for movements to a place."""
    command: Tensor
    """Command of the base, [C, 2]."""
    carry: Tensor
    """Position of a held object in the agent root frame, [3] [m]."""
    changes: int
    """Number of the step of a pick or a place in which the object is taken or released."""

    @classmethod
    def of(
        cls,
        body: Robot | Humanoid,
        objects: int,
        oracle: OracleSpec,
        device: torch.device,
        dtype: torch.dtype,
        parts: int = 0,
    ) -> Choices:
        """Return the table of choices of a robot or a person."""
        opening = [kind for kind in (NAV_HANDLE, OPEN, CLOSE) for _ in range(parts)]
        who, primitives, (changes, ends) = HUMAN, list[Any](), oracle.person_steps
        if isinstance(body, Robot):
            who, primitives, (changes, ends) = ROBOT, list(PRIMITIVES.values()), oracle.robot_steps
        kinds = [kind for kind in range(4) for _ in range(objects)] + list(range(WAIT, WAIT + 1 + len(primitives)))
        own = len(kinds)  # what all tasks have
        handling = [0] * (2 * objects) + [ends] * (2 * objects)

        def whole(values: list[int]) -> Tensor:
            return torch.tensor(values, dtype=torch.int64, device=device)

        still = [(0.0, 0.0)] * (4 * objects + 1)
        return cls(
            who=who,
            kind=whole([*kinds, *opening]),
            target=whole([*list(range(objects)) * 4, *[0] * (1 + len(primitives) + len(opening))]),
            part=whole([*[0] * own, *list(range(parts)) * 3]),
            steps=whole(
                [
                    *handling,
                    CHOICE_WAIT_STEPS,
                    *(steps for *_, steps in primitives),
                    *(0 if kind == NAV_HANDLE else ends for kind in opening),
                ]
            ),
            command=torch.tensor(
                [*still, *((f, t) for f, t, _ in primitives), *[(0.0, 0.0)] * len(opening)], dtype=dtype, device=device
            ),
            carry=torch.tensor(carry_point(body), dtype=dtype, device=device),
            changes=changes,
        )

    def __len__(self) -> int:
        return len(self.kind)


class Turn(NamedTuple):
    """Agent with its current choice, before it moves."""

    does: SubGoal
    kind: Tensor
    """Kind of the agent's current choice; -1 if it does nothing."""
    goes: Tensor
    """True if the agent is moving to a place, bool [W]."""
    spot: Tensor
    """Position of the object or goal to which the agent goes, [W, 3] [m]."""


def of_object(values: Tensor, k: Tensor) -> Tensor:
    """Select the values of one object in each world from values [W, K]."""
    return values.gather(1, k[:, None])[:, 0]


def one_of(number: Tensor, count: int) -> Tensor:
    """Return masks bool [W, count] that are True only for the thing with the number [W]."""
    return number[:, None] == torch.arange(count, device=number.device)


def precondition(choices: Choices, number: Tensor, hands: Hands) -> Tensor:
    """Return whether `sim_kinematic.agents.skills.Objects.why_not` accepts choices [W], or all choices [W, C]."""
    kind, k = choices.kind[number], choices.target[number]
    flat = k if k.ndim == 2 else k[:, None]
    holder = hands.held_by.gather(1, flat).reshape(k.shape)
    full = (hands.held_by == choices.who).any(1)
    full = full[:, None] if k.ndim == 2 else full
    mine, free = holder == choices.who, holder == NOBODY
    other = ~full | (kind < OPEN)
    return torch.where(
        kind == NAV_OBJECT,
        free,
        torch.where(kind == PICK, free & ~full, torch.where(kind == PLACE, mine, other)),
    )


def every_choice(choices: Choices, worlds: int) -> Tensor:
    """Return the numbers of all choices, [W, C]."""
    return torch.arange(len(choices), device=choices.kind.device).expand(worlds, -1)


def begin(
    choices: Choices,
    does: SubGoal,
    chosen: Tensor,
    places: Places,
    xz: Tensor,
    heading: Tensor,
    bearing: float,
    hands: Hands,
    oracle: OracleSpec,
) -> Turn:
    """Start the choices ``chosen`` [W] of free agents; infeasible choices fail without a motion in this step."""
    objects, free = places.tables.objects, does.skill == FREE
    number = torch.where(free, chosen, does.skill)
    kind, k = choices.kind[number], choices.target[number]
    at_goal = (kind == NAV_GOAL) | (kind == PLACE) | of_object(hands.moved, k)
    wanted = (choices.who * 2 + at_goal.long()) * objects + k
    if places.tables.parts:
        handle = 6 * objects + choices.who * places.tables.parts + choices.part[number]
        wanted = torch.where(kind >= NAV_HANDLE, handle, wanted)
    field = torch.where(free, wanted, does.field)
    spot = places.spots(field)
    first = places.first(field, xz)
    goes, handles = (kind == NAV_OBJECT) | (kind == NAV_GOAL), (kind == PICK) | (kind == PLACE)
    if places.tables.parts:
        goes, handles = goes | (kind == NAV_HANDLE), handles | (kind >= OPEN)
    gap = places.ends(field) - xz[:, None]
    reached = reaches(oracle, gap, error_to(xz, heading, spot[:, 0::2], bearing))
    can = precondition(choices, number, hands) & (~goes | (first >= 0)) & (~handles | reached)
    starts, fails = free & can, free & ~can
    zero = torch.zeros_like(does.timer)
    does = does._replace(
        skill=torch.where(starts, number, does.skill),
        field=torch.where(starts, field, does.field),
        way=torch.where(starts & goes, first, does.way),
        best=torch.where(starts, torch.inf, does.best),
        since=torch.where(starts, zero, does.since),
        timer=torch.where(starts, zero, does.timer),
        last=torch.where(free, number, does.last),
        outcome=torch.where(free, torch.where(fails, FAILED, RUNNING), does.outcome),
    )
    busy = does.skill != FREE
    return Turn(does, torch.where(busy, kind, -1), busy & goes, spot)


def interrupted(does: SubGoal, chosen: Tensor, may: Tensor) -> SubGoal:
    """Let agents for which ``may`` [W] is True change their choice if it differs from their current one."""
    stops = (does.skill != FREE) & may & (chosen != FREE) & (chosen != does.skill)
    return does._replace(
        skill=torch.where(stops, FREE, does.skill),
        last=torch.where(stops, does.skill, does.last),
        outcome=torch.where(stops, ABORTED, does.outcome),
    )


def error_to(xz: Tensor, heading: Tensor, point: Tensor, bearing: float = 0.0) -> Tensor:
    """Return the angle by which agents must turn to have points [W, 2] at a given bearing to their left, [W] [rad]."""
    gap = point - xz
    return wrap_angle(torch.atan2(-gap[:, 1], gap[:, 0]) - bearing - heading)


def _go_on(turn: Turn, places: Places, xz: Tensor, within_m: float) -> tuple[SubGoal, Tensor, Tensor, Tensor]:
    """Return the point that each agent goes to now, how far it is, and whether it is the end of the path."""
    does = turn.does
    point = places.points(does.field, does.way)
    gap = point - xz
    away = torch.hypot(gap[:, 0], gap[:, 1])
    hops = turn.goes & (does.way < places.n) & (away <= within_m)
    way = torch.where(hops, places.after(does.field, does.way), does.way)
    point = torch.where(hops[:, None], places.points(does.field, way), point)
    gap = point - xz
    away = torch.where(hops, torch.hypot(gap[:, 0], gap[:, 1]), away)
    does = does._replace(way=way, best=torch.where(hops, torch.inf, does.best))
    return does, point, away, way >= places.n


def move_robots(
    choices: Choices, turn: Turn, robot: RobotTensors, places: Places, grids: Grids, base: BaseSpec, bearing: float
) -> tuple[RobotTensors, SubGoal]:
    """Move the bases by one step; a robot that has arrived and turned, or is stuck, becomes free."""
    xz, heading, spot = robot.xz, robot.heading, turn.spot[:, 0::2]
    does, point, away, is_end = _go_on(turn, places, xz, VIA_M)
    there = is_there(away, is_end, does.best, does.since)
    facing = error_to(xz, heading, spot, bearing)
    error = torch.where(there, facing, error_to(xz, heading, point))
    stride = base.max_speed_mps * STEP_S
    ahead, aside = error.cos().clamp_min(0.0) ** 2, error.sin().abs()
    forward = torch.minimum(ahead, 0.5 * base.max_turn_rad_s * STEP_S * away / (aside * stride).clamp_min(1e-9))
    forward = torch.where(is_end, torch.minimum(forward, away / stride), forward)
    turned = (error / (base.max_turn_rad_s * STEP_S)).clamp(-1.0, 1.0)
    going = torch.stack([torch.where(there, 0.0, forward), turned], -1)
    primitive = torch.where((turn.kind > WAIT)[:, None], choices.command[does.skill.clamp_min(0)], 0.0)
    robot = drive_robots(grids, robot, torch.where(turn.goes[:, None], going, primitive), base)
    on_the_way, turning = left_to_do(away, facing)
    left = torch.where(there, turning, on_the_way)
    better = gets_on(left, does.best)
    does = does._replace(
        best=torch.where(turn.goes & better, left, does.best),
        since=torch.where(turn.goes, torch.where(better, 0, does.since + 1), does.since),
    )
    gap = point - robot.xz
    there = is_there(torch.hypot(gap[:, 0], gap[:, 1]), is_end, does.best, does.since)
    done = turn.goes & there & (error_to(robot.xz, robot.heading, spot, bearing).abs() < FACING_RAD)
    return robot, _ended(does, done, turn.goes & ~done & (does.since > STUCK_STEPS))


def move_people(turn: Turn, person: HumanTensors, places: Places, walker: WalkerSpec) -> tuple[HumanTensors, SubGoal]:
    """Move the people by one step; a person who has arrived and turned becomes free."""
    spot, within = turn.spot[:, 0::2], walker.arrive_m
    does, point, away, is_end = _go_on(turn, places, person.xz, within)
    turns = turn.goes & is_end & (away <= within)
    most = walker.turn_rad_s * STEP_S
    turned = torch.where(turns, error_to(person.xz, person.heading, spot).clamp(-most, most), 0.0)
    moved = walk_humans(person, torch.where((turn.goes & ~turns)[:, None], point, person.xz), walker)
    person = moved._replace(heading=moved.heading + turned)
    gap = point - person.xz
    arrived = is_end & (torch.hypot(gap[:, 0], gap[:, 1]) <= within)
    done = turn.goes & arrived & (error_to(person.xz, person.heading, spot).abs() < AIMED_RAD)
    return person, _ended(does, done, torch.zeros_like(done))


def handle(
    choices: Choices, kind: Tensor, does: SubGoal, hands: Hands, spot: Tensor, root: Tensor, heading: Tensor
) -> tuple[SubGoal, Hands]:
    """Move held objects with the agent at ``root`` [W, 3], carry out picks and places, and end timed skills."""
    who, k = choices.who, choices.target[does.skill.clamp_min(0)]
    timed = (kind >= PICK) & (kind != NAV_HANDLE) & (does.skill != FREE)
    timer = torch.where(timed, does.timer + 1, does.timer)
    one = one_of(k, hands.held_by.shape[1])
    now = timed & (timer == choices.changes)
    places, picks = now & (kind == PLACE), now & (kind == PICK)
    misses = picks & ((of_object(hands.held_by, k) != NOBODY) | (of_object3(hands.objects, k) != spot).any(1))
    takes = (picks & ~misses)[:, None] & one
    puts = places[:, None] & one
    held_by = torch.where(takes, who, torch.where(puts, NOBODY, hands.held_by))
    carried = in_hand(choices.carry, root, heading)
    objects = torch.where((held_by == who)[..., None], carried[:, None], hands.objects)
    objects = torch.where(puts[..., None], spot[:, None], objects)
    placed_by = torch.where(puts, who, torch.where(takes, NOBODY, hands.placed_by))
    moved = (hands.moved | puts) & ~takes
    opened = hands.opened
    if opened.shape[1]:
        part = one_of(choices.part[does.skill.clamp_min(0)], opened.shape[1])
        opens, closes = ((now & (kind == wanted))[:, None] & part for wanted in (OPEN, CLOSE))
        opened = (opened | opens) & ~closes
    over = timed & (timer >= choices.steps[does.skill.clamp_min(0)])
    does = _ended(does._replace(timer=timer), over & ~misses, misses)
    return does, Hands(objects, held_by, moved, placed_by, opened)


def of_object3(values: Tensor, k: Tensor) -> Tensor:
    """Select the vectors [W, 3] of one object in each world from vectors [W, K, 3]."""
    return values.gather(1, k[:, None, None].expand(-1, 1, values.shape[-1]))[:, 0]


def in_hand(carry: Tensor, root: Tensor, heading: Tensor) -> Tensor:
    """Return the world positions [W, 3] [m] of carried objects, from their position in the agent root frame [3] [m]."""
    c, s = heading.cos(), heading.sin()
    x, z = root[:, 0] + c * carry[0] + s * carry[2], root[:, 2] - s * carry[0] + c * carry[2]
    return torch.stack([x, root[:, 1] + carry[1], z], -1)


def _ended(does: SubGoal, done: Tensor, failed: Tensor) -> SubGoal:
    over = done | failed
    return does._replace(
        skill=torch.where(over, FREE, does.skill),
        outcome=torch.where(done, DONE, torch.where(failed, FAILED, does.outcome)),
    )
