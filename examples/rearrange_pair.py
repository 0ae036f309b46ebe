"""One idea: a robot and a person share the work, and the time that this saves. Usage: python examples/rearrange_pair.py"""

import h3data
from h3data.metrics import measure
from sim_kinematic.tasks.rearrange.codec import solo_steps_of
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate

home = h3data.build_home(h3data.HomeSpec(preset="small", seed=1))
task = Rearrange()
episode = task.episode(home, seed=3)
for target in episode.targets:
    print(f"{target.name}: from {target.source} to {target.destination}")
alone = solo_steps_of(task, episode)
print(f"\nthe person alone: {alone} steps")

for policy in ("complement", "same_object", "still"):
    recording = simulate(task, episode, {"robot": policy, "human": "both"})
    values = measure(recording).values
    print(f"{policy}: {recording.episode.info['ended']} after {len(recording)} steps, RE {values['RE']:.0f} %")
    for span in recording.skills:
        if span.agent == 0 and span.name in ("pick", "place"):
            print(f"  step {span.start_step:3d}  {span.name} {span.target}: {span.outcome} {span.reason}")
