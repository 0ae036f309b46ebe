"""Habitat's formats with their readers and writers, as entry points of the group ``h3data.formats``.

They are recognised by `h3data.formats.builtin_formats`.
"""

from __future__ import annotations

from dataclasses import replace

from h3data.formats.builtin_formats import BUILT_IN

_RECOGNISED = {one.name: one for one in BUILT_IN}

GFX_REPLAY = replace(
    _RECOGNISED["gfx_replay"],
    read="h3data_habitat.gfx.replay:read_gfx_replay",
    read_options=("fps",),
    write="h3data_habitat.exporters.gfx_replay_export:export_gfx_replay",
    write_options=("assets", "person_detail", "people"),
)
HITL_EPISODE = replace(
    _RECOGNISED["hitl_episode"],
    read="h3data_habitat.hitl.sessions:read_hitl_episode",
    read_options=("assets",),
)
HITL_LOG = replace(
    _RECOGNISED["hitl_log"],
    read="h3data_habitat.hitl.paper_logs:read_hitl_log",
    read_options=("fps", "assets"),
)
PICKLE = replace(_RECOGNISED["pickle"], read=HITL_LOG.read, read_options=HITL_LOG.read_options)
NAVMESH = replace(_RECOGNISED["navmesh"], hint="read it with h3data_habitat.navmesh.file.read_navmesh")
HABITAT_EPISODES = replace(
    _RECOGNISED["habitat_episodes"],
    write="h3data_habitat.exporters.episodes:export_habitat_episodes",
    target="folder",
    many=True,
)
