"""Controllers: what an agent has chosen becomes what moves it, whoever chose: a script, a planner, a network, a person."""
