"""Habitat dataset folders written for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import trimesh

from h3data.scene.records import Scene
from h3data_habitat.scenes.scene_instance import load_habitat_scene

CHEST = """<robot name="chest">
  <link name="base"><inertial><origin xyz="0 0 0.5"/></inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
    <collision><geometry><box size="1 1 1"/></geometry></collision></link>
  <link name="b_drawer"><visual><geometry><box size="0.8 0.8 0.2"/></geometry></visual></link>
  <link name="a_lid"><visual><geometry><box size="1 0.1 1"/></geometry></visual></link>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="b_drawer"/><origin xyz="0 0 0.2"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.5"/></joint>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="a_lid"/>
    <origin xyz="0 0.5 0" rpy="1.5707963267948966 0 0"/><axis xyz="1 0 0"/><limit lower="-1" upper="1"/></joint>
</robot>"""


class Dataset:
    """A dataset folder with a stage ``room`` and a chest; a test adds what it needs."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.config = root / "home.scene_dataset_config.json"
        self.json(
            self.config.name,
            {
                "stages": {"paths": {".json": ["stages"]}},
                "objects": {"paths": {".json": ["objects"]}},
                "articulated_objects": {"paths": {".urdf": ["urdf/*"], ".json": ["urdf/*"]}},
                "light_setups": {"paths": {".json": ["lighting"]}},
                "semantic_scene_descriptor_instances": {
                    "default_attributes": {"semantic_descriptor_filename": "lexicon.json"},
                    "paths": {".json": ["semantics"]},
                },
                "navmesh_instances": {"walk": "navmeshes/one.navmesh"},
                "scene_instances": {"paths": {".json": ["scenes"]}},
            },
        )
        self.mesh("stages/room.glb", trimesh.creation.box(extents=(10, 0.2, 8)))
        self.json("stages/room.stage_config.json", {"render_asset": "room.glb"})
        self.write("urdf/chest/chest.urdf", CHEST)

    def write(self, name: str, text: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def json(self, name: str, content: Any) -> Path:
        return self.write(name, json.dumps(content))

    def mesh(self, name: str, mesh: Any) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh.export(path)

    def brick(self, **attributes: Any) -> None:
        self.mesh("objects/brick.glb", trimesh.creation.box(extents=(2, 4, 6)))
        self.json("objects/brick.object_config.json", {"render_asset": "brick.glb", **attributes})

    def load(self, *objects: dict[str, Any], articulated: Any = (), options: Any = None, **more: Any) -> Scene:
        content = {
            "stage_instance": {"template_name": "room"},
            "object_instances": list(objects),
            "articulated_object_instances": list(articulated),
            **more,
        }
        self.json("scenes/one.scene_instance.json", content)
        return load_habitat_scene(self.config, "one", **(options or {}))

    def chest(self, *, options: Any = None, **entry: Any) -> Scene:
        return self.load(articulated=[{"template_name": "chest", **entry}], options=options)
