"""Back end for the CPU: the rasteriser with its shading, for any number of worlds and threads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from queue import SimpleQueue

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.outputs import Poses, picture_arrays
from h3data.render.raster.clusters import enclosing_box, fill_boxes, fill_packets, smooth_normals
from h3data.render.raster.drawings import Drawing, Drawings, Shown
from h3data.render.raster.raster import Placement, Target, View, rasterise, reach_of
from h3data.render.raster.raster_read import read_depth, read_ids, read_parallel_depth, read_triangles
from h3data.render.scene import RenderScene
from h3data.render.shade.blockers import Blockers
from h3data.render.shade.shading import KeptPicture, Light, shade


class CpuEngine:
    """Renderer of perspective and orthographic cameras on the CPU, with one image per thread.

    Pixels do not depend on the number of threads. If a camera has not moved since an earlier image, only the changed
    parts are rendered again, with the same pixels as a result.
    """

    def __init__(self, scene: RenderScene, *, light: Light, worlds: int = 1, threads: int = 1) -> None:
        self.scene = scene
        self.light = light
        self.worlds = [World(scene) for _ in range(worlds)]
        self.threads = threads
        # each thread borrows buffers for one image, so their number is that of threads, not that of images
        self._free: SimpleQueue[Drawings] = SimpleQueue()
        for _ in range(threads):
            self._free.put(Drawings())

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        # made at the first use: most programs render with one thread
        return ThreadPoolExecutor(self.threads, thread_name_prefix="h3data-render")

    # --- state --------------------------------------------------------------------------------------------------------
    def set_transforms(self, world: int, instances: NDArray[np.intp], matrices: NDArray[np.float64]) -> None:
        """Set transforms [n, 4, 4] of instances in one world."""
        self.worlds[world].set_transforms(instances, matrices)

    def set_visible(self, world: int, instances: NDArray[np.intp], visible: NDArray[np.bool_]) -> None:
        """Show or hide instances in one world."""
        self.worlds[world].set_visible(instances, visible)

    def set_vertices(self, world: int, mesh: int, vertices: NDArray[np.float32]) -> None:
        """Replace the vertices [V, 3] of a deformable mesh in one world."""
        self.worlds[world].set_vertices(mesh, vertices)

    def set_blockers(self, world: int, blockers: Blockers | None) -> None:
        """Set the capsules that cast soft shadows in one world; None removes them."""
        self.worlds[world].blockers = blockers

    def poses(self, world: int) -> Poses:
        """Copy of the transforms, vertices and visibility in one world."""
        return self.worlds[world].poses()

    # --- images -------------------------------------------------------------------------------------------------------
    def render(
        self,
        cameras: Sequence[Camera],
        worlds: Sequence[int],
        outputs: Sequence[str],
        samples: int,
        out: Mapping[str, NDArray] | None,
    ) -> dict[str, NDArray]:
        """Render one image per camera and world, in several threads."""
        results = picture_arrays(cameras, outputs, out)
        # before the threads begin, which would otherwise write to the same arrays; depth needs no normals
        if "rgb" in outputs or "normal" in outputs:
            for world in sorted(set(worlds)):
                self.worlds[world].refresh_normals()
        jobs = [
            (camera, self.worlds[world], {name: array[k] for name, array in results.items()}, samples)
            for k, (camera, world) in enumerate(zip(cameras, worlds, strict=True))
        ]
        if self.threads > 1 and len(jobs) > 1:
            list(self._pool.map(lambda job: self._render(*job), jobs))
        else:
            for job in jobs:
                self._render(*job)
        return results

    def _render(self, camera: Camera, world: World, results: Mapping[str, NDArray], samples: int) -> None:
        drawings = self._free.get()
        try:
            self._rasterise(camera, world, drawings, results, samples)
        finally:
            self._free.put(drawings)

    def _rasterise(
        self, camera: Camera, world: World, drawings: Drawings, results: Mapping[str, NDArray], samples: int
    ) -> None:
        if not camera.is_planar:
            raise InputError(
                f"Cameras of the projection {camera.projection} need the package h3data_rays, which this installation does not "
                "have. Hint: install h3data as a whole.",
                code="H3-RENDER-099",
            )
        at_centres = [name for name in results if name != "rgb"]
        if at_centres or (samples == 1 and "rgb" in results):
            view, drawing, again = self._draw(camera, world, drawings)
            self._read(world, view, drawing.target, results)
            rgb = results.get("rgb") if samples == 1 else None
            # a kept picture goes with the last image, and these two branches do not bring it up to date
            if "normal" in results:
                drawing.picture = None
                self._shade(world, view, drawing.target, rgb=rgb, normal=results["normal"])
            elif rgb is not None:
                self._picture(world, view, drawing, rgb, None, again=again)
            else:
                drawing.picture = None
        # four samples need twice as many pixels per axis; ids and depth stay at the centres, where they cannot be
        # averaged
        if samples == 4 and "rgb" in results:
            view, drawing, again = self._draw(camera, world, drawings, fine=2)
            self._picture(world, view, drawing, results["rgb"], self.scene.patches, again=again)

    def _draw(self, camera: Camera, world: World, drawings: Drawings, *, fine: int = 1) -> tuple[View, Drawing, bool]:
        """Return the view, a drawing that shows it, and whether it showed an earlier image of the same view before."""
        view, scene = view_of(camera, fine=fine), self.scene
        shown = world.shown(camera.hidden_layers)
        placement = Placement(scene.instance_mesh, world.matrix, shown)
        # depends on what is visible, so it is part of the key below: another reach means other numbers everywhere
        if view.parallel:
            view = view._replace(reach=reach_of(world.geometry, placement, view))
        # all of the view that has to be equal for an earlier image to be of use, bit for bit
        key = repr((camera.hidden_layers, id(world), view[3:])).encode()
        key += view.axes.tobytes() + view.eye.tobytes() + view.intrinsics.tobytes()
        drawing = drawings.of(key, view, draws=scene.draw_limit, instances=len(scene.instances))
        # without instances nothing can be said to have changed, for which the kernels draw all of it (`Drawing.changed`)
        now = world.state(shown) if drawing.stands and len(shown) else None
        changed, again = drawing.changed(now, scene.instance_mesh), drawing.shown is not None
        drawing.shown = None
        # while it is drawn the buffers show nothing whole; an exception must not leave them marked as valid
        rasterise(world.geometry, scene.cutouts, placement, view, drawing.target, changed)
        drawing.shown = now
        return view, drawing, again

    def _picture(
        self,
        world: World,
        view: View,
        drawing: Drawing,
        rgb: NDArray[np.uint8],
        patches: NDArray[np.int32] | None,
        *,
        again: bool,
    ) -> None:
        """Shade a drawing into ``rgb``, or only the part that the picture of its last image lacks."""
        kept = drawing.picture if again else None
        drawing.picture = None
        # the second image of a view: a camera that moves never gets here, and need not keep pictures
        if again and kept is None:
            kept = KeptPicture(np.empty_like(rgb))
        self._shade(world, view, drawing.target, rgb=rgb, patches=patches, kept=kept)
        drawing.picture = kept

    def _read(self, world: World, view: View, target: Target, results: Mapping[str, NDArray]) -> None:
        scene = self.scene
        if "depth" in results and view.parallel:
            read_parallel_depth(target.inv_z, view.reach, results["depth"])
        elif "depth" in results:
            read_depth(target.inv_z, results["depth"])
        if "instance" in results:
            read_ids(target.words, target.draws, scene.ids, results["instance"])
        if "semantic" in results:
            read_ids(target.words, target.draws, scene.semantic_ids, results["semantic"])
        if "triangle" in results:
            packets = world.geometry.cluster_packets
            read_triangles(target.words, target.draws, packets, scene.packet_triangles, results["triangle"])

    def _shade(
        self,
        world: World,
        view: View,
        target: Target,
        *,
        rgb: NDArray[np.uint8] | None = None,
        normal: NDArray[np.float32] | None = None,
        patches: NDArray[np.int32] | None = None,
        light: Light | None = None,
        kept: KeptPicture | None = None,
    ) -> None:
        placement = Placement(self.scene.instance_mesh, world.matrix, world.visible)
        shade(
            world.geometry,
            world.surface,
            placement,
            view,
            target,
            light or self.light,
            rgb,
            normal,
            world.blockers,
            patches,
            kept,
        )


class World:
    """State of one world: transforms, visibility, deformed vertices and their normals."""

    def __init__(self, scene: RenderScene) -> None:
        self.scene = scene
        self.matrix = scene.instance_matrix.copy()
        self.visible = np.ones(len(scene.instances), np.bool_)
        self.vertices: dict[int, NDArray[np.float32]] = {}
        self.moved = np.isin(scene.instance_mesh, scene.deformable)
        """Instances that have ever moved or may deform, shape [I]."""
        self.blockers: Blockers | None = None
        self.version = 0
        """Number of changes so far."""
        self.geometry = scene.geometry
        self.surface = scene.surface
        self._stale_normals: set[int] = set()
        if scene.deformable:
            shared = scene.geometry
            # copies of what deforms only; packets of meshes that never change are shared by all worlds
            self.geometry = shared._replace(
                own_packets=shared.own_packets.copy(),
                center=shared.center.copy(),
                half=shared.half.copy(),
                mesh_center=shared.mesh_center.copy(),
                mesh_half=shared.mesh_half.copy(),
            )
            self.surface = scene.surface._replace(normals=scene.surface.normals.copy())

    def shown(self, hidden_layers: tuple[str, ...]) -> NDArray[np.bool_]:
        """Return whether each instance [I] is visible to a camera that hides layers."""
        if not hidden_layers:
            return self.visible
        return self.visible & ~np.isin(self.scene.layers, hidden_layers)

    def state(self, shown: NDArray[np.bool_]) -> Shown:
        """Return the current state from which an image with these visible instances [I] follows."""
        tints = np.ones((len(shown), 4), np.float32) if self.blockers is None else self.blockers.tints.copy()
        return Shown(self.matrix.copy(), shown.copy(), dict(self.vertices), tints)

    def set_transforms(self, instances: NDArray[np.intp], matrices: NDArray[np.float64]) -> None:
        """Set transforms [n, 4, 4] of instances."""
        self.matrix[instances] = matrices
        # for ever: what has never moved is prepared once for rays (`h3data_rays`), so what moves must
        # stay out of it
        self.moved[instances] = True
        self.version += 1

    def set_visible(self, instances: NDArray[np.intp], visible: NDArray[np.bool_]) -> None:
        """Show or hide instances."""
        self.visible[instances] = visible
        self.version += 1

    def set_vertices(self, mesh: int, vertices: NDArray[np.float32]) -> None:
        """Replace the vertices [V, 3] [m] of a deformable mesh; the array is stored without a copy."""
        scene, geometry = self.scene, self.geometry
        self.vertices[mesh] = vertices
        self.version += 1
        # a mesh without triangles has no clusters whose boxes could be computed
        if not len(scene.meshes[mesh].faces):
            return
        part, clusters = scene.parts[mesh], scene.cluster_range(mesh)
        packets = geometry.own_packets[scene.own_packet_range(mesh)]
        center, half = geometry.center[clusters], geometry.half[clusters]
        fill_packets(vertices, part.corners, packets)
        fill_boxes(vertices, *scene.members[mesh], center, half)
        geometry.mesh_center[mesh], geometry.mesh_half[mesh] = enclosing_box(center, half)
        if mesh in scene.groups:
            # not now: somebody who asks for depth only never needs them
            self._stale_normals.add(mesh)

    def refresh_normals(self) -> None:
        """Update the smooth normals of deformed meshes."""
        for mesh in sorted(self._stale_normals):
            first, end = self.scene.first_vertex[mesh : mesh + 2]
            groups = self.scene.groups[mesh]
            sums = np.empty((int(groups.max(initial=-1)) + 1, 3), np.float32)
            faces, normals = self.scene.meshes[mesh].faces, self.surface.normals[first:end]
            smooth_normals(self.vertices[mesh], faces, groups, sums, normals)
        self._stale_normals.clear()

    def poses(self) -> Poses:
        """Return a copy of the transforms, vertices and visibility."""
        # copies, since the world goes on while somebody looks at them
        return Poses(self.matrix.copy(), dict(self.vertices), self.visible.copy())


def view_of(camera: Camera, *, fine: int = 1) -> View:
    """Convert a planar camera to a `View`, with ``fine`` times as many pixels per axis; the caller sets ``reach``."""
    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64) * fine
    pose = np.asarray(camera.pose, np.float64)
    return View(
        axes=np.ascontiguousarray(pose[:3, :3]),
        eye=np.ascontiguousarray(pose[:3, 3]),
        intrinsics=k,
        width=camera.width * fine,
        height=camera.height * fine,
        parallel=camera.projection == "orthographic",
        near=float(camera.near),
        far=float(camera.far),
        reach=0.0,
    )
