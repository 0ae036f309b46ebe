"""Tasks whose agents have skills: they pick and place objects, open and close doors and drawers."""
