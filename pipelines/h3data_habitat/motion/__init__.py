"""Motion of Habitat's humanoids: files, the gait of its controller, its pick."""
