"""What draws the world of a `RearrangeSession` as it is now: arms and hands where they are, objects where they lie or are
held."""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.errors import InputError
from h3data.geometry import Array
from sim_kinematic.agents.robot_skills import RobotActor
from sim_kinematic.tasks.rearrange.session import RearrangeSession

if TYPE_CHECKING:
    from sim_kinematic.sensing.camera_sensor import StateRenderer
    from sim_kinematic.tasks.rearrange.episode import RearrangeWorld


class RearrangeStage:
    """Draws whichever episode the session plays."""

    def __init__(self, session: RearrangeSession) -> None:
        self._session = session
        self._world: RearrangeWorld | None = None
        self._drawn: StateRenderer | None = None

    def posed(self) -> StateRenderer:
        """What draws the world, with everything where it is now.

        Raises:
            InputError: no episode has begun.
        """
        from sim_kinematic.sensing.camera_sensor import StateRenderer

        play = self._session.play
        if play is None:
            raise InputError("No episode has begun. Hint: call reset() first.")
        world = play.world
        if self._drawn is None or self._world is not world:
            bodies, names = [member.body for member in world.cast], [target.name for target in world.targets]
            self._world, self._drawn = world, StateRenderer(world.scene, bodies, objects=names)
        self._drawn.pose(play.state, frames=[self._frames(number) for number in range(len(world.cast))])
        return self._drawn

    def _frames(self, number: int) -> Array:
        """Frames of an agent's links [1, L, 4, 4] or joints [1, 55, 4, 4]."""
        assert self._session.play is not None
        actor = self._session.play.actors[number]
        if isinstance(actor, RobotActor):
            return actor.robot.link_matrices(actor.pose[None], actor.joints[None])
        return actor.person.joint_matrices[None]
