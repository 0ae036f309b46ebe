"""What Habitat's users hold: scenes, episodes, navigation meshes, replays, human-in-the-loop sessions."""
