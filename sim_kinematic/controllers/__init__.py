"""Controllers, which turn the choices of a policy into motion of its agent."""
