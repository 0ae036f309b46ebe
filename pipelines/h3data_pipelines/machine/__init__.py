"""Commands about this machine: installed packages, speed, caches and the shell."""
