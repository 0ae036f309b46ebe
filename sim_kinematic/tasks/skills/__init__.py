"""Tasks whose agents have skills: they take things and put them down, open and close."""
