"""Controllers, which turn the choices of a policy into motion of its agent.

In every step a rollout (`sim_kinematic.tasks.play.WorldRollout`) calls ``begin(step)`` of each agent's controller. While its
``status`` is ``choosing``, the rollout gives a choice of the policy to ``start(world, agent, rows, choices)`` and calls
``step(world, agent, rows)``. That returns the command of this step. It returns None if the agent has been moved already, or has
to choose once more. ``rows`` [n] are the worlds concerned.
"""
