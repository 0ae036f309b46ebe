"""W worlds in one home with any robots and people: step them, and say who touches whom.

```python
worlds = AgentWorlds(scene, "robot,robot,human", worlds=16)
worlds.reset(seed=0)
touching = worlds.step([drive, drive, way_points])  # [16, 2] each; touching [16, 3]: of worlds.pairs
```
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.roster import AgentSpec, make_roster, sample_places
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.clearance import clip_reach, robot_reach
from sim_kinematic.contact.frames import body_frames, body_shapes, shape_frames
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import HumanState, RobotState, WorldState
from sim_kinematic.motion.step import drive_robots, walk_humans


class AgentWorlds:
    """W worlds with the same agents: robots that are driven, people who walk to way points."""

    def __init__(
        self, scene: Scene, agents: str | Sequence[str] = ("robot", "human"), *, worlds: int = 1,
        spec: SocialNavSpec | None = None, free: FreeSpace | None = None,
    ) -> None:  # fmt: skip
        """
        Args:
            scene: The home.
            agents: Who is there (`make_roster`).
            worlds: W.
            spec: Speeds and radii; ``spawn_distance_m`` is how far apart they begin, where there is room.
            free: The map, which saves building it again.

        Raises:
            InputError: there are no such agents, or W is not at least 1.
        """
        if isinstance(worlds, bool) or not isinstance(worlds, int | np.integer) or worlds < 1:
            raise InputError(f"Expected at least 1 world, a whole number, got {worlds!r}.")
        self.scene, self.spec = scene, spec or SocialNavSpec()
        size = self.spec.agent_radius_m, self.spec.agent_height_m
        self.free = free or FreeSpace.from_scene(scene, radius_m=size[0], height_m=size[1])
        self.cast: tuple[AgentSpec, ...] = make_roster(agents)
        robots = [member.body for member in self.cast if isinstance(member.body, Robot)]
        self.state = WorldState.zeros(
            int(worlds), robots=len(robots), people=len(self.cast) - len(robots), joints=[len(r.rest) for r in robots]
        )
        self.pairs = tuple(combinations(range(len(self.cast)), 2))
        """Numbers (a < b) of all pairs of agents."""
        self.touching = np.zeros((self.state.worlds, len(self.pairs)), np.bool_)
        """Which pairs touch after the last step, [W, P]."""
        self._contacts = AgentContacts(*(body_shapes(member.body) for member in self.cast))
        self._reach = [
            robot_reach(m.body, m.body.rest) if isinstance(m.body, Robot) else clip_reach(m.body) for m in self.cast
        ]
        self.bases = tuple(base_of(m.body, self.spec.robot) for m in self.cast if isinstance(m.body, Robot))
        """Discs and limits of each robot."""
        robots_free = (floor_of(r, base, scene, self.free) for r, base in zip(robots, self.bases, strict=True))
        self.floors = (*robots_free, *[self.free] * (len(self.cast) - len(robots)))
        """The floor on which each agent finds its paths."""

    def reset(self, seed: int) -> None:
        """Everybody at a random free place of each world, at rest.

        Raises:
            SceneError: there is no room for them.
        """
        self.place(np.stack([self._places(generator(seed, "agent_worlds", world=w)) for w in range(self.state.worlds)]))

    def place(self, places: Array) -> None:
        """Everybody at ``(x, z, heading)``, [W, A, 3] or [A, 3] in all worlds, at rest."""
        joints = [own.joints.shape[1] for own in self.state.robots]
        self.state.put(
            slice(None), WorldState.zeros(1, robots=len(joints), people=len(self.state.people), joints=joints)
        )
        for k, (member, own) in enumerate(zip(self.cast, self.state.agents, strict=True)):
            own.xz[:], own.heading[:] = places[..., k, :2], places[..., k, 2]
            if isinstance(own, RobotState) and isinstance(member.body, Robot):
                own.joints[:] = member.body.rest
        self.touching = self._touching()

    def _places(self, rng: np.random.Generator) -> Array:
        return sample_places(
            self.scene, self.free, self.cast, rng, apart_m=self.spec.spawn_distance_m, rules=self.spec.robot
        )  # fmt: skip

    def step(self, actions: Sequence[ArrayLike]) -> NDArray[np.bool_]:
        """Move all agents by one step and return which pairs touch, [W, P].

        Args:
            actions: One array for each agent: of a robot forward and left turn, -1..1 of its limits, [W, 2]; of a person the
                way point ``(x, z)`` that she walks straight to, [W, 2].

        Raises:
            InputError: there is not one for each agent, or one has another shape or is not finite; then nothing has moved.
        """
        state = self.state
        if len(actions) != len(self.cast):
            raise InputError(f"Expected one action for each of {len(self.cast)} agents, got {len(actions)}.")
        rows = [np.asarray(action, np.float64) for action in actions]
        for member, row in zip(self.cast, rows, strict=True):
            width = 3 if member.kind == "robot" and self.spec.robot.max_lateral_mps else 2
            if row.shape != (state.worlds, width) or not np.isfinite(row).all():
                raise InputError(
                    f"Expected finite actions of {member.name}, shape {[state.worlds, width]}, got shape {list(row.shape)}"
                    f"{'' if np.isfinite(row).all() else ' with numbers that are not finite'}."
                )
        bases = (*self.bases, *[self.spec.robot] * len(state.people))
        for member, own, row, base in zip(self.cast, state.agents, rows, bases, strict=True):
            if isinstance(own, HumanState):
                walk_humans(own, row, self.spec.human)
                if isinstance(member.body, Humanoid):
                    draw_arms(own, self.free, member.body, self.spec.human.arms)
            else:
                drive_robots(own, self.free, row, base)
        self.touching = self._touching()
        return self.touching

    def _touching(self) -> NDArray[np.bool_]:
        """By distance first, then by FCL in the worlds where a pair is near."""
        agents = self.state.agents
        near = np.zeros((self.state.worlds, len(self.pairs)), np.bool_)
        for p, (a, b) in enumerate(self.pairs):
            near[:, p] = np.hypot(*(agents[a].xz - agents[b].xz).T) <= self._reach[a] + self._reach[b]
        found = np.zeros_like(near)
        rows = np.flatnonzero(near.any(1))
        if not len(rows):
            return found
        speed, floor_y = self.spec.human.speed_mps, self.free.floor_y
        frames = [
            shape_frames(member.body, body_frames(member.body, own.take(rows), floor_y, speed_mps=speed))
            for member, own in zip(self.cast, agents, strict=True)
        ]
        for k, w in enumerate(rows):
            for number, of in enumerate(frames):
                self._contacts.update(number, of[k])
            for p in np.flatnonzero(near[w]):
                found[w, p] = self._contacts.collides(*self.pairs[p])
        return found
