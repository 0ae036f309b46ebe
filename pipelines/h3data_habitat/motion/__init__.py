"""Motion of Habitat's humanoids: files, the walk of its controller, its pick."""
