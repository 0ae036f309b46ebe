"""Parts of a building that only homes with several storeys have."""

from __future__ import annotations

from h3data.scene.homes.kinds.kind import Kind

BUILDING = {
    name: Kind(name=name, semantic_id=number, role="building", mass_kg=mass, grasp="none")
    for name, number, mass in (("stairs", 7, 900.0), ("railing", 8, 12.0))
}
