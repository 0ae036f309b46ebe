"""Simulation of people and robots that share a home, and tools to record, render, measure and inspect what they do.

This example reads the episode that ``h3data demo -o out/demo/`` writes:

```python
import h3data

rec = h3data.load_recording("out/demo/episode.mcap")  # scene, agents, steps and events of one episode
print(rec)                                     # a summary: names and array shapes
state = h3data.Replay(rec).at(step=420)        # poses and joints of all agents at one step
image = h3data.render_frame(rec, camera="third_person", step=420)["rgb"]  # uint8 [H, W, 3]
print(h3data.measure(rec))                     # the metrics of the Habitat 3.0 paper
```

The main functions, by purpose:

- Simulate: `simulate` (one episode), `generate` (a dataset), `session` (step by step), `make` (a training environment).
- Open: `open` (anything, by name), `load_recording`, `load_dataset`, `load_scene`; `build_home` generates a home.
- Look: `render_frame`, `rerender` (videos), `view` (Rerun or HTML), `report`.
- Measure: `measure`, `evaluate` (several policies in the same episodes), `run_benchmark`, `verify_benchmark`.
- Exchange: `import_`, `export`, `card`, `push`, `pull`, `sync`.

Every error that a user can fix is an `H3DataError`. ``h3data docs python`` shows the guide to these functions. Each name is
imported at first use, so ``import h3data`` is quick.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from h3data.moved import announce_moves

announce_moves()

if TYPE_CHECKING:
    from h3data.api import load_dataset, load_recording, load_scene, measure, open, render_frame
    from h3data.errors import H3DataError
    from h3data.recording import Dataset, Episodes, Recording
    from h3data.replay import Replay
    from h3data.scene import Scene
    from h3data_homes import HomeSpec, build_home
    from h3data_pipelines.api import (
        card,
        evaluate,
        export,
        generate,
        import_,
        pull,
        push,
        rerender,
        run_benchmark,
        sync,
        verify_benchmark,
    )
    from h3data_viewers.api import report, view
    from sim_kinematic.envs.make import make
    from sim_kinematic.tasks.sessions import session, simulate

_HOMES = {
    "load_dataset": "h3data.api",
    "load_recording": "h3data.api",
    "load_scene": "h3data.api",
    "make": "sim_kinematic.envs.make",
    "open": "h3data.api",
    "render_frame": "h3data.api",
    "session": "sim_kinematic.tasks.sessions",
    "simulate": "sim_kinematic.tasks.sessions",
    "measure": "h3data.api",
    "card": "h3data_pipelines.api",
    "evaluate": "h3data_pipelines.api",
    "export": "h3data_pipelines.api",
    "generate": "h3data_pipelines.api",
    "import_": "h3data_pipelines.api",
    "pull": "h3data_pipelines.api",
    "push": "h3data_pipelines.api",
    "report": "h3data_viewers.api",
    "rerender": "h3data_pipelines.api",
    "run_benchmark": "h3data_pipelines.api",
    "sync": "h3data_pipelines.api",
    "verify_benchmark": "h3data_pipelines.api",
    "view": "h3data_viewers.api",
    "H3DataError": "h3data.errors",
    "Dataset": "h3data.recording",
    "Episodes": "h3data.recording",
    "Recording": "h3data.recording",
    "Replay": "h3data.replay",
    "HomeSpec": "h3data_homes",
    "Scene": "h3data.scene",
    "build_home": "h3data_homes",
}

__all__ = [
    "Dataset",
    "Episodes",
    "H3DataError",
    "HomeSpec",
    "Recording",
    "Replay",
    "Scene",
    "build_home",
    "card",
    "evaluate",
    "export",
    "generate",
    "import_",
    "load_dataset",
    "load_recording",
    "load_scene",
    "make",
    "measure",
    "open",
    "pull",
    "push",
    "render_frame",
    "report",
    "rerender",
    "run_benchmark",
    "session",
    "simulate",
    "sync",
    "verify_benchmark",
    "view",
]

# Gymnasium 1 reads no entry points: its ids need an import, and this is the one that people have (if Gymnasium is
# imported later, `announce_moves` sees to it)
if "gymnasium" in sys.modules:
    importlib.import_module("h3data.envs")


def __getattr__(name: str) -> Any:
    from h3data.plugins import import_name, own_version, suggest

    if name == "__version__":
        return own_version()
    if name not in _HOMES:
        raise AttributeError(f"module 'h3data' has no attribute {name!r}.{suggest(name, __all__, lead='It has')}")
    return import_name(_HOMES[name], name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
