"""Commands about studies with people."""
