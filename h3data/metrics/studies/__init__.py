"""Studies with people: plan, power, analysis."""
