"""Command ``h3data language``, which lists templates of tasks in words and verifies tasks."""
