"""Shading of the visibility buffer on the CPU; the GPU back end shares its tables.

- `shading`: `Light`, RGB and normals; `shading_setup`, `shading_simd`: its inner steps
- `occlusion`, `occlusion_simd`: ambient occlusion from the depth buffer
- `textures`, `textures_simd`: mip levels and their look-up; `cutouts`: holes in textures
- `surface`: the mesh data that these modules read; `borrowed`: arrays without reference counts
"""
