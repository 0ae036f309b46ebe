"""Motion of Habitat's humanoids: motion files, and the gait and pick of Habitat's controllers."""
