"""Files of other programs, read into our records. Foreign conventions (axes, quaternion order, frames) end here."""

from h3data.interop.assets import AssetLibrary
from h3data.interop.gfx_replay import read_gfx_replay
from h3data.interop.habitat_export import export_habitat, export_habitat_dataset
from h3data.interop.habitat_scene import load_habitat_scene
from h3data.interop.hitl_gen1 import read_hitl_log
from h3data.interop.hitl_session import read_hitl_episode
from h3data.interop.meshes import load_mesh
from h3data.interop.sniff import FileKind, sniff

__all__ = [
    "AssetLibrary",
    "FileKind",
    "export_habitat",
    "export_habitat_dataset",
    "load_habitat_scene",
    "load_mesh",
    "read_gfx_replay",
    "read_hitl_episode",
    "read_hitl_log",
    "sniff",
]
