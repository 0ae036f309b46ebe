"""Commands about this machine: what is installed, how fast it is, its shell."""
