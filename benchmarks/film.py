"""Faults of the film of a morning that the documentation shows (`examples/morning.py`): exactly that episode.

With ``--episodes N``, those of the same morning with each of the seeds 1 to N are printed too.

``penetration.film.above_2cm``, ``penetration.film.worst``
    Share of steps in which any part of anybody is deeper than 2 cm in the home, and the greatest depth, as in
    `benchmarks.penetration`, without the doors that people move (see `benchmarks.chores`).
``motion.film.pops``
    Steps in which a joint of a person pops, as in `benchmarks.motion`.
``people.film.contacts``, ``people.film.gridlocks``
    Steps in which agents touch, and gridlocks of people, as in `benchmarks.people`.

    python -m benchmarks film
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.motion import motions
from benchmarks.people import Walks, describe
from h3data.recording import Recording
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_pipelines.validation.penetration import penetrations, unintended_depth
from sim_kinematic.motion.spec import SocialNavSpec

SCRIPT = Path(__file__).parents[1] / "examples" / "morning.py"


def script() -> Any:
    """Return the module of the film; the policy of its people is found by the module's name."""
    if SCRIPT.stem not in sys.modules:
        spec = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[SCRIPT.stem] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[SCRIPT.stem])
    return sys.modules[SCRIPT.stem]


def figures_of(recording: Recording, scene: str) -> dict[str, tuple[float, str]]:
    """Return the figures of a recording of people in a home, by name, with their units."""
    depth, rules = unintended_depth(penetrations(recording, moved=False)), SocialNavSpec()
    source = named_scenes(scene)[0].source
    free = open_free_space(source, rules.agent_radius_m, rules.agent_height_m)
    walks = Walks.of(recording, open_scene(source), free)
    human = [k for k, agent in enumerate(recording.agents) if agent.kind == "human"]
    # a robot that drives about is nobody who gets on
    crowd, hours = describe([walks.only(human)]), len(recording) * len(human) / 30 / 3600
    return {
        "penetration.film.above_2cm": (float((depth > 0.02).mean()), f"of {len(depth)} steps"),
        "penetration.film.worst": (1000 * float(depth.max()), "mm"),
        "motion.film.pops": (float(sum(found["pops"].sum() for found in motions(recording))), "steps"),
        "people.film.contacts": (float(walks.touching.sum()), "steps"),
        "people.film.gridlocks": (hours * crowd["gridlocks_per_person_hour"][0], "n"),
    }


def run(emit: Callable[[str, float, str], None], episodes: int = 0) -> None:
    """Emit the figures of the film, and how many of the seeds from 1 to ``episodes`` have no fault."""
    film, faultless = script(), 0
    for seed in range(1, episodes + 1):
        figures = {name: value for name, (value, _) in figures_of(film.play(seed), film.SCENE).items()}
        worst = figures.pop("penetration.film.worst")
        faultless += not any(figures.values())
        faults = ", ".join(f"{name} {value:.3g}" for name, value in figures.items() if value)
        print(f"  seed {seed}: {worst:.1f} mm; {faults or 'no fault'}", flush=True)
    if episodes:
        emit("people.film.faultless", faultless, f"of {episodes} seeds")
    for name, (value, unit) in figures_of(film.play(), film.SCENE).items():
        emit(name, value, unit)
