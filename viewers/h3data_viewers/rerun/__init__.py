"""Recordings as Rerun files.

`rrd_file` assembles a file from one or two recordings. `entities` logs agents, rigid objects and skins, `cameras` their
views, `floor_marks` free space and goals, `timeseries` plots, lanes and the event log; `layout` arranges the window.
`sink` and `transforms` assign entity paths and times; `mesh_budget` keeps meshes small.
"""
