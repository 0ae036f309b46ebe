"""Episode files of habitat-lab and PARTNR."""
