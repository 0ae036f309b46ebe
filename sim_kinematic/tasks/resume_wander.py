"""Recordings of wandering agents simulated again: robots are driven by the recorded commands, people follow from the seed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording import Event, Recording
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.resimulation import (
    MAX_STEPS,
    Verification,
    compared,
    header_from,
    origin,
    require,
    require_kept,
    require_step,
    scene_and_map,
)
from sim_kinematic.tasks.wander import wander
from sim_kinematic.world import AgentWorlds


def verify(recording: Recording) -> Verification:
    """As `sim_kinematic.tasks.resume.verify`."""
    simulated, _ = _simulated(recording, until=len(recording), steps=len(recording))
    return compared(recording, simulated, "max_steps") if simulated else Verification(steps=0, difference=None)


def resume(recording: Recording, step: int) -> Recording:
    """As `sim_kinematic.tasks.resume.resume`: everybody wanders on."""
    require_step(recording, step)
    steps = recording.episode.info.get("max_steps")
    if not isinstance(steps, int) or isinstance(steps, bool) or not len(recording) <= steps <= MAX_STEPS:
        raise InputError(f"Expected max_steps in the info, from {len(recording)} to {MAX_STEPS}, got {steps!r}.")
    columns, events = _simulated(recording, until=step, steps=steps)
    require_kept(recording, step, columns, "max_steps")
    header = header_from(recording, f"resume:{step}")
    info = {**header.episode.info, "resumed_from": origin(recording, step)}
    return Recording(
        episode=replace(header.episode, info=info), assets=header.assets, bodies=header.bodies, agents=header.agents,
        columns=columns, events=tuple(events), attachments=header.attachments,
    )  # fmt: skip


def _simulated(recording: Recording, *, until: int, steps: int) -> tuple[dict[str, NDArray[Any]], list[Event]]:
    """Columns and events of ``steps`` steps, the first ``until`` under the recorded commands; nothing of no steps."""
    agents, info = recording.agents, recording.episode.info
    robots = [k for k, agent in enumerate(agents) if agent.kind == "robot"]
    names = [f"agent_{k}.action" for k in robots]
    require(recording, info=("spec", "starts"), columns=names)
    try:
        spec = msgspec.convert({"human": {}, **info["spec"]}, SocialNavSpec)
        starts = np.array(msgspec.convert(info["starts"], list[tuple[float, float, float]]), np.float64)
    except msgspec.ValidationError as fault:
        raise InputError(f"The recording's info is malformed: {str(fault).replace('`', '')}") from None
    commands = {k: recording.columns[name][:until] for k, name in zip(robots, names, strict=True)}
    if not all(c.shape == (until, 2) and np.isfinite(c).all() for c in commands.values()):
        raise InputError(f"Expected actions of finite numbers [T, 2] in {', '.join(names)}.")
    scene, free = scene_and_map(recording.attachments["scene.glb"], spec.agent_radius_m, spec.agent_height_m)
    models = [f"{agent.kind}:{agent.model.partition('/')[2]}" for agent in agents]
    if [member.kind for member in make_roster(models)] != [agent.kind for agent in agents]:
        raise InputError(f"Expected robots, then people, got: {[agent.kind for agent in agents]}.")
    if starts.shape != (len(agents), 3) or not np.isfinite(starts).all() or not free.is_navigable(starts[:, :2]).all():
        raise InputError(f"Expected starts on the free floor for {len(agents)} agents, got: {starts.tolist()}.")
    if not steps:
        return {}, []
    worlds = AgentWorlds(scene, models, spec=spec, free=free)
    worlds.place(starts)
    return wander(worlds, recording.episode.seed, steps, commands)
