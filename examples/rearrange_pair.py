"""One idea: a robot and a person share the work, and what that saves. Usage: python examples/rearrange_pair.py"""

import h3data
from h3data.metrics import measure
from h3data.scene import FreeSpace
from sim_kinematic.tasks.rearrange.episode import RearrangeWorld
from sim_kinematic.tasks.rearrange.simulate import simulate_rearrange, solo_steps_of

home = h3data.build_home(h3data.HomeSpec(preset="small", seed=1))
world = RearrangeWorld.create(home, seed=3, free=FreeSpace.from_scene(home))
for target in world.targets:
    print(f"{target.name}: from {target.source} to {target.destination}")
alone = solo_steps_of(world)
print(f"\nthe person alone: {alone} steps")

for policy in ("complement", "same_object", "still"):
    recording = simulate_rearrange(world, policy=policy, partner="both", solo_steps=alone)
    values = measure(recording).values
    print(f"{policy}: {recording.episode.info['ended']} after {len(recording)} steps, RE {values['RE']:.0f} %")
    for span in recording.skills:
        if span.agent == 0 and span.name in ("pick", "place"):
            print(f"  step {span.start_step:3d}  {span.name} {span.target}: {span.outcome} {span.reason}")
