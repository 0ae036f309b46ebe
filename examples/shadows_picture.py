"""A person and a robot in three homes, in flat and in baked light, as a contact sheet: docs/pictures/shadows.jpg.

python examples/shadows_picture.py docs/pictures/shadows.jpg
"""

import sys
from pathlib import Path

import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.geometry import ground_pose
from h3data.render import Renderer, RenderInstance, RenderScene
from h3data.render.image_files import write_jpg
from h3data.render.light.sources import sources_of
from h3data.render.sheets.scene_map import render_scene
from h3data.replay.shadow_casters import shadow_casters
from h3data.scenes import FreeSpace, HomeSpec, build_home
from h3data_light.bake import lit_scene
from h3data_pipelines.assets.eye_level import eye_level_camera

ROOMS = (("small", 7, "living"), ("medium", 7, "living"), ("small", 15, "kitchen"), ("large", 7, "library"))
person, robot = load_humanoid("female_0"), load_robot("quad_arm")
links = [number for number, link in enumerate(robot.links) if link.mesh is not None]

rows = []
for preset, seed, category in ROOMS:
    home = build_home(HomeSpec(preset=preset, seed=seed))
    free, plain = FreeSpace.from_scene(home), render_scene(home)
    room = next(room.name for room in home.rooms if room.category == category)
    camera = eye_level_camera(home, free, room=room, width=640, height=440)

    # everything that moves comes after the home: the person, then the links of the robot
    first = len(plain.instances)
    meshes = [*plain.meshes, person.mesh, *(robot.links[n].mesh for n in links)]
    moving = [RenderInstance(len(plain.meshes) + k, np.eye(4)) for k in range(1 + len(links))]
    fixed = {instance.name for instance in home.static_instances}
    static = [k for k, instance in enumerate(plain.instances) if instance.name in fixed]
    lit = lit_scene(meshes, [*plain.instances, *moving], static, sources_of(home), name=home.name)

    # both stand before the camera, where there is room
    ahead, right = camera.pose[[0, 2], 2], camera.pose[[0, 2], 0]
    wanted = [camera.pose[[0, 2], 3] + 2.9 * ahead + side * right for side in (-0.7, 0.8)]
    places = free.snap(np.array(wanted))
    poses = [ground_pose(np.array([place]), np.array([yaw])) for place, yaw in zip(places, (2.0, 0.8), strict=True)]
    quats, pelvis = person.walk_pose(np.array([1.2]), np.array([0.3]))
    joints = person.joint_matrices(poses[0], quats, pelvis)
    body, capsules = person.skin(joints, lod=False)[0], person.capsules_world(joints)
    frames = robot.link_matrices(poses[1], robot.rest[None])[0, links]
    numbers = np.arange(first + 1, first + 1 + len(links))

    pictures = []
    for baked in (False, True):
        source = (lit.meshes, lit.instances) if baked else (meshes, [*plain.instances, *moving])
        scene = RenderScene(*source, deformable=[len(plain.meshes)], mirrors=lit.mirrors if baked else None)
        renderer = Renderer(scene, light=lit.light if baked else None)
        renderer.set_vertices(len(plain.meshes), body)
        renderer.set_transforms(numbers, frames)
        if baked and lit.field is not None:
            agents = {first: 0} | dict.fromkeys(numbers.tolist(), 1)
            casters = shadow_casters(lit.field, lit.meshes, lit.instances, agents)
            of_person = np.column_stack([capsules[0][0], capsules[1][0], capsules[2]])
            renderer.set_blockers(casters.blockers([(numbers, frames)], {first: of_person}))
        pictures.append(renderer.render(camera, outputs=("rgb",), samples=4)["rgb"])
    rows.append(np.hstack(pictures))

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/shadows.jpg")
out.parent.mkdir(parents=True, exist_ok=True)
write_jpg(out, np.vstack(rows), quality=85)
print(out)
