"""Tasks whose agents have skills: they pick and place objects, and open and close doors and drawers."""
