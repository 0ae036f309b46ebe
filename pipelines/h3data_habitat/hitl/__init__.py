"""Human-in-the-loop sessions of habitat-hitl."""
