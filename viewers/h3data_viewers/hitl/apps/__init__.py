"""Built-in apps."""
