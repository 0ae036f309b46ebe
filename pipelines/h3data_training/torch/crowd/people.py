"""Step of the people of crowds in W worlds as tensors: what each chooses, and how their bodies follow.

`sim_kinematic.crowd.step.step_crowd` is the reference, for people without company, routine or reaction; both agree step by
step (tests/training/torch/test_crowds.py). People are on an axis before that of the worlds, [P, W]. Pairs of a person and
somebody near are [P, N, W], where N counts the P people, then the discs of the robot.

Two rules differ from the CPU, because a device cannot search for paths:

- Each person has a chain of goals, made on the host with the paths between them. A path begins at the previous goal, not
  where the person has come within reach of it.
- People who make no progress turn round and walk their chain in reverse, until they are stuck again or at its beginning.
  On the CPU they choose another goal, a path around everybody near, or back out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from h3data_training.torch.crowd.avoidance import (
    NEVER,
    HalfPlanes,
    dot,
    half_planes,
    interactions,
    length,
    nearest_velocities,
)
from h3data_training.torch.step import Grids, heading_direction, push_out, sample_sdf, wrap_angle
from sim_kinematic.crowd.crowd import ARRIVED_M
from sim_kinematic.crowd.step import (
    AHEAD_M,
    BACK_M,
    CREEP_MPS,
    FOOT_M,
    FOOT_ROOM_M,
    FOOT_S,
    PROGRESS_M,
    SLIDES,
    START_M,
    STRIDE_M,
    WALL_M,
)
from sim_kinematic.crowd.traits import CrowdSpec
from sim_kinematic.motion.spec import STEP_S, StrideSpec
from sim_kinematic.motion.stride import PROGRESS_M as SEARCH_M

SIGHT_M, SIGHTS = 0.05, 32
"""Distance from an obstacle to the line between two places below which it hides them from each other [m], and largest number
of strides along that line: 30 sufficed for 9,000 random lines of up to 6 m in homes of h3-homes/val."""
SEARCHES = 24
"""Largest number of steps of `SEARCH_M` by which the place on a path advances in a step. Walking fast takes 4; more are needed
after a goal, near the beginning of the next path."""
GIVES_WAY = 30
"""Number of places on the path of another person that people who give way look at, `AHEAD_M` apart."""


class CrowdTensors(NamedTuple):
    """State of the people of all worlds beside their poses, [P, W] each."""

    leg: Tensor
    """Number of the leg of the person's chain of goals, int64."""
    back: Tensor
    """True if the person walks the leg from its end to its beginning, bool."""
    along: Tensor
    """Progress along the leg [m]."""
    best: Tensor
    """Largest progress so far [m], and in ``best_step`` the step in which it was made."""
    best_step: Tensor
    claim: Tensor
    """One more than the step in which the person came to the narrow place ahead; 0 if there is none."""
    turn: Tensor
    """Turn rate of the body [rad/s], and in ``speed`` its speed [m/s]."""
    speed: Tensor
    direction: Tensor
    """Direction of walking [rad]."""
    chosen: Tensor
    """Chosen velocity, [P, W, 2] [m/s]."""
    touching: Tensor
    """True if the robot touches the person, bool."""

    @classmethod
    def standing(cls, heading: Tensor) -> CrowdTensors:
        """Return the state of people who stand with headings [P, W] at the beginning of their chains."""
        zero, flags = torch.zeros_like(heading), torch.zeros_like(heading, dtype=torch.bool)
        first = torch.ones_like(heading)  # people begin to walk in step 1
        return cls(
            torch.zeros_like(heading, dtype=torch.int64),
            flags,
            zero,
            zero,
            first,
            zero,
            zero,
            zero,
            heading,
            torch.stack([zero, zero], -1),
            flags,
        )

    def tensors(self) -> Iterator[Tensor]:
        """Return all tensors of the state, in a fixed order."""
        yield from self


@dataclass(frozen=True, kw_only=True, eq=False)
class Paths:
    """Paths as polylines of at most K points, one in each of R rows, or one of each person [P, W] (`at`)."""

    points: Tensor
    """Points [..., K, 2] [m]; the last one fills the row."""
    lengths: Tensor
    """Distance along the path up to each point [..., K] [m]; infinite for those that fill the row."""
    last: Tensor
    """Number of the last point, int64 [...]."""
    total: Tensor
    """Length of the path [...] [m]."""

    def at(self, row: Tensor) -> Paths:
        """Return the paths in given rows."""
        row = row.contiguous()
        return Paths(points=self.points[row], lengths=self.lengths[row], last=self.last[row], total=self.total[row])

    def of(self, person: Tensor) -> Paths:
        """Return the paths [P, W] of the persons with the numbers ``person`` [P, W] of each world."""
        world = torch.arange(person.shape[1], device=person.device)
        return Paths(
            points=self.points[person, world],
            lengths=self.lengths[person, world],
            last=self.last[person, world],
            total=self.total[person, world],
        )

    @property
    def end(self) -> Tensor:
        """Last points [..., 2] [m]."""
        return self.points[..., -1, :]

    def point(self, along: Tensor) -> Tensor:
        """Return the points [n, P, W, 2] at distances ``along`` [n, P, W] [m] (`sim_kinematic.motion.stride.point_along`)."""
        at = along.movedim(0, -1).contiguous()
        k = torch.searchsorted(self.lengths.contiguous(), at).clamp_min(1).minimum(self.last[..., None])
        before, after = self.lengths.gather(-1, k - 1), self.lengths.gather(-1, k)
        size = after - before
        share = torch.where(size > 0.0, ((at - before) / size.clamp_min(1e-12)).clamp(0.0, 1.0), 1.0)[..., None]
        k = k[..., None].expand(*k.shape, 2)
        a, b = self.points.gather(-2, k - 1), self.points.gather(-2, k)
        return (a + share * (b - a)).movedim(-2, 0)


class Surroundings(NamedTuple):
    """Everybody in the worlds before a step."""

    xz: Tensor
    """Places of the people, then of the discs of the robot, [N, W, 2] [m]."""
    velocity: Tensor
    """Their velocities [N, W, 2] [m/s]."""
    radius: Tensor
    """Radii of their discs [N, W] [m]."""


class Claims(NamedTuple):
    """Narrow places that people are in or before, [P, W] each."""

    since: Tensor
    """One more than the step in which the person came to the place; 0 if there is none."""
    place: Tensor
    """Point where the place begins for them [P, W, 2] [m]."""
    line: Tensor
    """Direction in which they pass it [P, W, 2]."""
    inside: Tensor
    """True if they are in it, bool."""


@dataclass(frozen=True, kw_only=True)
class CrowdRules:
    """Rules of the people of all worlds."""

    spec: CrowdSpec
    stride: StrideSpec
    forces: bool
    """True for social force, False for reciprocal avoidance."""

    @property
    def sixth(self) -> bool:
        """Return whether the rules are of version 6 (`sim_kinematic.crowd.crowd.VERSION`)."""
        return self.spec.version > 5

    def step(
        self,
        grids: Grids,
        all_paths: Paths,
        rows: Tensor,
        legs: Tensor,
        traits: Any,
        crowd: CrowdTensors,
        xz: Tensor,
        heading: Tensor,
        around: Surroundings,
        step: Tensor,
    ) -> tuple[Tensor, Tensor, CrowdTensors]:
        """Return places [P, W, 2], headings [P, W] and state of all people after a step.

        Args:
            grids: Grid of each world.
            all_paths: Legs of all people; a leg and the same leg in reverse are next to each other.
            rows: Row of the first leg of each person, int64 [P, W].
            legs: Number of legs of each person, int64 [P, W].
            traits: `sim_kinematic.crowd.traits.Traits` of the people, [P, W] each.
            crowd: State of the people.
            xz: Places of the people [P, W, 2] [m].
            heading: Headings of the people [P, W] [rad].
            around: Places and velocities of everybody.
            step: Number of the step, [W].
        """
        crowd = self._next_legs(all_paths, rows, legs, traits, crowd, xz, step)
        paths = all_paths.at(rows + 2 * crowd.leg + crowd.back)
        along = _progress(paths, crowd.along, xz)
        better = along > crowd.best + PROGRESS_M
        crowd = crowd._replace(
            along=along,
            best=torch.where(better, along, crowd.best),
            best_step=torch.where(better, step, crowd.best_step),
        )
        claims = self._claims(grids, paths, crowd, xz, step)
        firsts, gives = self._firsts(claims)
        aside = self._yielding(grids, paths, crowd, xz, claims, firsts)
        ahead = self._wanted(grids, paths, along, xz, traits.speed_mps)
        # with nothing of the path behind them they cannot go back
        yields = gives & ~(claims.inside & (along < START_M))
        wanted = torch.where(yields[..., None], aside, ahead)
        velocity = self._chosen(grids, crowd, xz, heading, around, firsts, gives, wanted, traits)
        # each decides at steps of their own, so that not all decide in the same one
        pause = (traits.reaction_s / STEP_S + 0.5).floor().clamp_min(1.0)
        number = torch.arange(len(xz), device=xz.device)[:, None]
        decides = torch.remainder(step + number, pause) == 0.0
        crowd = crowd._replace(claim=claims.since, chosen=torch.where(decides[..., None], velocity, crowd.chosen))
        return self._followed(grids, crowd, xz, heading, around)

    def _next_legs(
        self,
        all_paths: Paths,
        rows: Tensor,
        legs: Tensor,
        traits: Any,
        crowd: CrowdTensors,
        xz: Tensor,
        step: Tensor,
    ) -> CrowdTensors:
        """Return the state with the next leg of people who have arrived, and the same in reverse of those who are stuck."""
        now = rows + 2 * crowd.leg + crowd.back
        arrived = length(all_paths.end[now] - xz) < ARRIVED_M
        stuck = ~arrived & ((step - crowd.best_step) * STEP_S > traits.patience_s)
        leg = torch.where(arrived, crowd.leg + torch.where(crowd.back, -1, 1), crowd.leg)
        # at its ends the chain is walked the other way
        back = ((crowd.back ^ stuck) & (leg >= 0)) | (leg >= legs)
        begins = arrived | stuck
        along = torch.where(stuck, all_paths.total[now] - crowd.along, 0.0)
        return crowd._replace(
            leg=leg.clamp_min(0).minimum(legs - 1),
            back=back,
            along=torch.where(begins, along, crowd.along),
            best=torch.where(begins, along, crowd.best),
            best_step=torch.where(begins, step, crowd.best_step),
            claim=torch.where(begins, 0.0, crowd.claim),
        )

    # --- narrow places ------------------------------------------------------------------------------------------------
    def _narrow(self, grids: Grids, xz: Tensor) -> Tensor:
        """Return whether two people cannot pass each other at places [..., W, 2] (`is_narrow`, from version 5 on)."""
        distance, slope = sample_sdf(grids, xz)
        missing = self.spec.narrow_m - distance
        away = slope / length(slope).clamp_min(1e-9)[..., None]
        # a little farther, as distances of the grid are interpolated
        beside = sample_sdf(grids, xz + away * (missing + 0.02)[..., None]).distance
        return (missing > 0.0) & (beside < self.spec.narrow_m)

    def _claims(self, grids: Grids, paths: Paths, crowd: CrowdTensors, xz: Tensor, step: Tensor) -> Claims:
        """Return the narrow places that people are in or before (`claim_passages`)."""
        inside = self._narrow(grids, xz)
        tried, at = [], crowd.along
        for _ in range(int(self.spec.wait_m / AHEAD_M) + 2):
            tried.append(at)
            at = at + AHEAD_M
        places = torch.stack(tried)
        within = places <= (crowd.along + self.spec.wait_m).minimum(paths.total)
        narrow = within & self._narrow(grids, paths.point(places))
        found = narrow.any(0)
        first = places.gather(0, narrow.to(torch.int8).argmax(0)[None])[0]
        at = torch.where(inside, crowd.along, first)
        a, b = paths.point(torch.stack([at, at + 0.4]))
        line = b - a
        since = torch.where(crowd.claim == 0.0, step + 1.0, crowd.claim)
        return Claims(
            torch.where(inside | found, since, 0.0), a, line / length(line).clamp_min(1e-9)[..., None], inside
        )

    def _firsts(self, claims: Claims) -> tuple[Tensor, Tensor]:
        """Return who passes a narrow place before each person, int64 [P, W], and whether anybody does (`first_through`)."""
        since, place, line, inside = claims
        gap = place[:, None] - place
        opposite = dot(line[:, None], line[None]) < -0.3
        near = length(gap) < self.spec.wait_m + 0.4
        number = torch.arange(len(since), device=since.device)
        j, m = number[None, :, None], number[:, None, None]
        earlier = (since < since[:, None]) | ((since == since[:, None]) & (j < m))
        # who is in the passage goes on before anybody who is still outside
        earlier = torch.where(inside == inside[:, None], earlier, inside.expand_as(earlier))
        goes = (since > 0.0) & (since[:, None] > 0.0) & (j != m) & opposite & near & earlier
        if self.sixth:  # they have passed
            goes = goes & ~(dot(gap, line[None]) < 0.0)
        return goes.to(torch.int8).argmax(1), goes.any(1)

    # --- wanted velocities --------------------------------------------------------------------------------------------
    def _wanted(self, grids: Grids, paths: Paths, along: Tensor, xz: Tensor, speed: Tensor) -> Tensor:
        """Return the velocities [P, W, 2] [m/s] towards a point ahead on the paths, slower before their ends."""
        room = sample_sdf(grids, xz).distance - WALL_M
        ahead = (0.3 + room.clamp_min(0.0)).clamp_max(0.9)
        gap = paths.point((along + ahead).minimum(paths.total)[None])[0] - xz
        distance = length(gap)
        left = torch.maximum(paths.total - along, distance)
        speed = torch.minimum(speed, (2.0 * self.stride.decel_mps2 * left).sqrt())
        velocity = gap / distance.clamp_min(1e-6)[..., None] * speed[..., None]
        return torch.where((distance < 1e-6)[..., None], 0.0, velocity)

    def _yielding(
        self, grids: Grids, paths: Paths, crowd: CrowdTensors, xz: Tensor, claims: Claims, firsts: Tensor
    ) -> Tensor:
        """Return the velocities [P, W, 2] [m/s] of people who give way: off the other's path, or back out of the passage."""
        spec = self.spec
        gap = paths.point((crowd.along - BACK_M).clamp_min(0.0)[None])[0] - xz
        distance = length(gap)
        out = torch.where((distance < 0.1)[..., None], 0.0, gap / distance.clamp_min(1e-6)[..., None] * spec.back_mps)
        theirs, begin = paths.of(firsts), crowd.along.gather(0, firsts)
        k = torch.arange(GIVES_WAY, device=xz.device)[:, None, None]
        away = xz - theirs.point((begin + k * AHEAD_M).minimum(theirs.total))
        nearest, which = length(away).min(0)
        off = away.gather(0, which[None, ..., None].expand(1, *which.shape, 2))[0]
        here = sample_sdf(grids, xz)
        slope = here.slope / grids.cell[..., None]
        off = torch.where((nearest < 1e-3)[..., None], slope, off)
        off = torch.where((here.distance < 0.4)[..., None], off + 0.5 * slope, off)  # not into the wall, but along it
        off = off / length(off).clamp_min(1e-9)[..., None] * spec.aside_mps
        # far enough from the other's path already
        off = torch.where((nearest >= spec.aside_m)[..., None], 0.0, off)
        return torch.where(claims.inside[..., None], out, off)

    # --- chosen velocities --------------------------------------------------------------------------------------------
    def _chosen(
        self,
        grids: Grids,
        crowd: CrowdTensors,
        xz: Tensor,
        heading: Tensor,
        around: Surroundings,
        firsts: Tensor,
        gives: Tensor,
        wanted: Tensor,
        traits: Any,
    ) -> Tensor:
        """Return the velocities [P, W, 2] [m/s] that people choose (`choose_velocity`)."""
        spec, people, everybody = self.spec, len(xz), len(around.xz)
        m = torch.arange(people, device=xz.device)[:, None, None]
        j = torch.arange(everybody, device=xz.device)[None, :, None]
        gap = around.xz - xz[:, None]
        distance, velocity = length(gap), around.velocity[:people]
        near = (j != m) & (distance <= spec.neighbour_m) & _sees(grids, xz, gap, distance)
        size = length(wanted)
        comes = dot(around.velocity[None], wanted[:, None]) < 0.1 * size[:, None]
        ahead = dot(wanted[:, None], gap) > 0.8 * size[:, None] * distance
        meets = (near & (distance < spec.approach_m) & ahead & comes).any(1) & (size > 0.1)
        # to the right is (-z, x) of a direction (x, z), with y up
        angle = torch.where(meets, traits.side * spec.approach_rad, 0.0)
        wanted = _turned(wanted, angle)
        clear, slope = sample_sdf(grids, xz)
        outward = slope / length(slope).clamp_min(1e-9)[..., None]
        relative = velocity[:, None] - around.velocity
        if self.forces:
            pull = spec.desired_gain * (wanted - velocity) / traits.relaxation_s[..., None]
            pushes = interactions(gap, relative, spec.lambda_, spec.gamma, spec.n, spec.n_prime)
            pull = pull + spec.social_gain * torch.where(near[..., None], pushes, 0.0).sum(1)
            wall = spec.wall_gain * torch.exp(-(clear - WALL_M).clamp_min(0.0) / spec.wall_range_m)
            pull = pull + wall[..., None] * outward
            # forces become a velocity over the time until the next decision
            wanted = velocity + pull * traits.reaction_s[..., None]
        foot = xz + (FOOT_M + FOOT_S * crowd.speed)[..., None] * heading_direction(heading)
        room, rises = sample_sdf(grids, foot)
        planes = [
            # the speed towards the nearest wall is at most that which reaches it at the end of the horizon
            HalfPlanes(outward, -(clear - WALL_M) / spec.wall_horizon_s),
            # the foot ahead comes no nearer to what it would step into
            HalfPlanes(
                rises / length(rises).clamp_min(1e-9)[..., None],
                (FOOT_ROOM_M - room).clamp_max(0.0) / spec.wall_horizon_s,
            ),
        ]
        of_crowd = (j < people).expand(people, -1, xz.shape[1])
        share = torch.where(of_crowd, 0.5, 1.0).to(xz.dtype)
        horizon = torch.full_like(share, spec.guard_s if self.forces else spec.horizon_s)
        if not self.forces:
            first = gives & (firsts == torch.arange(people, device=xz.device)[:, None, None])
            # who gives way is on the way out of the path
            way = torch.zeros_like(near)
            way[:, :people] = first
            mine = of_crowd & gives[:, None] & (firsts[:, None] == j)
            share = torch.where(way, spec.way_share, torch.where(mine, 1.0 - spec.way_share, share))
            horizon = torch.where(way, spec.way_horizon_s, horizon)
        reach = _reach(gap, around.radius[:people, None] + around.radius, heading[:, None], heading) + spec.comfort_m
        # discs that overlap come apart within half a second; offsets of changes become those of velocities
        avoid = half_planes(gap, relative, reach, horizon, 0.5, share)
        offset = avoid.offset
        if self.sixth:  # only changes that are needed are shared, and not what others leave free
            offset = torch.where(offset < 0.0, offset / share, offset)
        offset = torch.where(near, offset + dot(avoid.normal, velocity[:, None]), NEVER)
        normals = torch.cat([torch.stack([p.normal for p in planes]), avoid.normal.movedim(1, 0)])
        offsets = torch.cat([torch.stack([p.offset for p in planes]), offset.movedim(1, 0)])
        return nearest_velocities(HalfPlanes(normals, offsets), wanted, traits.speed_mps.clamp_min(1e-3))

    # --- bodies -------------------------------------------------------------------------------------------------------
    def _followed(
        self, grids: Grids, crowd: CrowdTensors, xz: Tensor, heading: Tensor, around: Surroundings
    ) -> tuple[Tensor, Tensor, CrowdTensors]:
        """Move the bodies as far as they can follow the chosen velocities (`follow`)."""
        s, dt = self.stride, STEP_S
        most = length(crowd.chosen)
        goes = most > 0.05
        most = torch.where(goes, most, 0.0)
        bearing = wrap_angle(torch.atan2(-crowd.chosen[..., 1], crowd.chosen[..., 0]) - heading)
        bearing = torch.where(goes, bearing, 0.0)
        turn = (s.steer_per_s * bearing).clamp(-s.turn_rad_s, s.turn_rad_s)
        quick = s.turn_accel_rad_s2 * dt
        turn = crowd.turn + (turn - crowd.turn).clamp(-quick, quick)
        # until they have turned they step aside, slowly
        slow = CREEP_MPS + (most - CREEP_MPS) * bearing.cos().clamp_min(0.0).square()
        held = (bearing.abs() > s.sidestep_rad) & (most > CREEP_MPS)
        most = torch.where(held, most.minimum(slow), most)
        speed = crowd.speed + (most - crowd.speed).clamp(-2.0 * s.decel_mps2 * dt, s.accel_mps2 * dt)
        off = wrap_angle(crowd.direction - heading)
        swing = 2.0 * s.sidestep_rad_s * dt
        aim = off + wrap_angle(bearing.clamp(-s.sidestep_rad, s.sidestep_rad) - off).clamp(-swing, swing)
        fast = speed > CREEP_MPS
        aim = torch.where(fast, aim, bearing)
        direction = torch.where((most > 0.0) | fast, heading + aim, crowd.direction)
        before, heading = heading, wrap_angle(heading + turn * dt)
        end = xz + heading_direction(direction) * (speed * dt)[..., None]
        here = sample_sdf(grids, xz).distance
        held = here.clamp_max(WALL_M)
        strikes = (speed > 0.0) & (sample_sdf(grids, end).distance < WALL_M)
        slid = push_out(grids, end, end, (0.0,), WALL_M, 6)
        clear, moved = sample_sdf(grids, slid).distance, length(slid - xz)
        share = torch.where(moved > 0.0, (speed * dt / moved.clamp_min(1e-12)).clamp_max(1.0), 1.0)
        slid = xz + share[..., None] * (slid - xz)
        fits = clear.minimum(sample_sdf(grids, slid).distance) >= held - 1e-3
        slower = speed.minimum((moved / dt).maximum(speed - s.decel_mps2 * dt))
        end = torch.where(strikes[..., None], torch.where(fits[..., None], slid, xz), end)
        speed = torch.where(strikes, torch.where(fits, slower, 0.0), speed)
        xz, speed = self._kept_apart(grids, xz, end, speed, before, heading, here, around)
        return xz, heading, crowd._replace(turn=turn, speed=speed, direction=direction)

    def _kept_apart(
        self,
        grids: Grids,
        xz: Tensor,
        end: Tensor,
        speed: Tensor,
        before: Tensor,
        heading: Tensor,
        here: Tensor,
        around: Surroundings,
    ) -> tuple[Tensor, Tensor]:
        """Return ends [P, W, 2] and speeds [P, W] of steps that lead into nobody; people move one after the other."""
        places, facing, speeds = list(around.xz), list(before), list(speed)
        people, slow = len(xz), 2.0 * self.stride.decel_mps2 * STEP_S
        for m in range(people):
            # before the distances to others, which depend on where the person looks
            facing[m] = heading[m]
            others = [j for j in range(len(places)) if j != m]
            gap = torch.stack([places[j] for j in others]) - xz[m]
            radius = torch.stack([around.radius[j] for j in others]) + around.radius[m]
            looks = torch.stack(facing[:m] + facing[m + 1 :]) if people > 1 else heading[:0]
            # the square of the length as on the CPU: rounding decides whether who slid past another still comes towards them
            reach, square = _reach(gap, radius, heading[m], looks), length(gap) * length(gap)
            step = end[m] - xz[m]
            going, least = torch.ones_like(step[:, 0], dtype=torch.bool), here[m].clamp_max(WALL_M)
            for attempt in range(SLIDES):
                closest, slid = torch.where(going, reach, 0.0), torch.zeros_like(speeds[m])
                for towards, near, apart in zip(gap, closest, square, strict=True):
                    along = (step * towards).sum(-1)
                    hits = (length(towards - step) < near) & (along > 0.0)
                    # without the part of the step that leads towards the other, it passes beside them
                    share = torch.where(hits, along / apart, 0.0)
                    step, slid = step - share[:, None] * towards, slid + share
                going = going & (slid > 0.0)
                stops = going
                if attempt < SLIDES - 1:
                    stops = going & (sample_sdf(grids, xz[m] + step).distance < least)
                step = torch.where(stops[:, None], 0.0, step)
                going = going & ~stops
            turned = (step != end[m] - xz[m]).any(-1)
            slower = torch.maximum(length(step) / STEP_S, speeds[m] - slow)
            speeds[m] = torch.where(turned, torch.where(speeds[m] > 0.0, slower, 0.0), speeds[m])
            places[m] = torch.where(turned[:, None], xz[m] + step, end[m])
        return torch.stack(places[:people]), torch.stack(speeds)


def _progress(paths: Paths, along: Tensor, xz: Tensor) -> Tensor:
    """Return the progress [P, W] [m] of people along their paths (`sim_kinematic.motion.stride.progress_along`)."""
    tried = [along]
    for _ in range(SEARCHES):
        tried.append((tried[-1] + SEARCH_M).minimum(paths.total))
    at = torch.stack(tried)
    gap = length(paths.point(at) - xz)
    # only forward and to the first nearest point: where a path folds back, its next leg may be nearer still
    nearer = (gap[1:] <= gap[:-1]) & (at[:-1] < paths.total)
    count = nearer.to(torch.int64).cumprod(0).sum(0, keepdim=True)
    return at.gather(0, count)[0]


def _sees(grids: Grids, xz: Tensor, gap: Tensor, distance: Tensor) -> Tensor:
    """Return whether lines ``gap`` [P, N, W, 2] from places [P, W, 2] are free (`sim_kinematic.crowd.reactions.sees`)."""
    start, unit = xz[:, None], gap / distance.clamp_min(1e-9)[..., None]
    at, hidden = torch.zeros_like(distance), torch.zeros_like(distance, dtype=torch.bool)
    for _ in range(SIGHTS):
        clear = sample_sdf(grids, torch.addcmul(start, unit, at[..., None])).distance
        hidden = hidden | ((at < distance) & (clear < SIGHT_M))
        at = at + clear.clamp_min(SIGHT_M)
    return ~hidden


def _reach(gap: Tensor, radius: Tensor, own: Tensor, heading: Tensor) -> Tensor:
    """Return the least distances [..., N, W] [m] between people and everybody (`sim_kinematic.crowd.step.reach_between`).

    Args:
        gap: Positions relative to the people [..., N, W, 2] [m], first those of other people.
        radius: Sums of the radii [..., N, W] [m].
        own: Headings of the people [..., 1, W] or [W] [rad].
        heading: Headings of the other people, who are the first of N, [.., W] [rad].
    """
    line = torch.atan2(-gap[..., 1], gap[..., 0])
    people = len(heading)
    reach = radius + STRIDE_M * (own - line).cos().square()
    theirs = STRIDE_M * (heading - line[..., :people, :]).cos().square()
    return torch.cat([reach[..., :people, :] + theirs, reach[..., people:, :]], -2)


def _turned(vector: Tensor, angle: Tensor) -> Tensor:
    """Return vectors (x, z) [..., 2] turned by angles [...] [rad] from x towards z."""
    c, s = angle.cos(), angle.sin()
    x, z = vector[..., 0], vector[..., 1]
    return torch.stack([x * c - z * s, z * c + x * s], -1)
