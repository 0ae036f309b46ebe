"""Files of Habitat: scenes, episodes, navigation meshes, replays and human-in-the-loop sessions."""

import h3data  # noqa: F401 - from then on, imports of modules that have moved say where they are
