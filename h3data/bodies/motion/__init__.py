"""Motion clips of other sources: files, retargeting, cycles."""
