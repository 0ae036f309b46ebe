"""Rasteriser for the CPU (research/rasteriser.md).

- `cpu`: the back end; `raster`: one image from frustum culling to the visibility buffer; `raster_read`: images from the
buffer
- `raster_draw` (clusters, occlusion culling), `raster_fill` (triangles), `raster_cutouts` (triangles with holes)
- `raster_simd`: the inner steps as 8-wide LLVM vectors (`h3data.kernels.vectors`)
- `clusters`: meshes cut into clusters of triangles, the input of the rasteriser
"""
