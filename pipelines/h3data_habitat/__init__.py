"""Files of Habitat's users: scenes, episodes, navigation meshes, replays, human-in-the-loop sessions."""

import h3data  # noqa: F401 - from then on, imports of modules that have moved say where they are
