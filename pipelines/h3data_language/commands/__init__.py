"""Command ``h3data language``: the templates of tasks in words, and the verification of tasks."""
