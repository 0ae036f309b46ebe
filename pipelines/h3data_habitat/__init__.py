"""Files of Habitat's users: scenes, episodes, navigation meshes, replays, human-in-the-loop sessions."""
