"""Homes of the second generation, with more styles and rooms and with objects that residents left lying around.

- `looks`: eight styles; `models`: furniture of the first generation with other looks, on the same footprint;
`pictures`: pictures on walls
- `rooms`: additional furniture of each kind of room, and the new kinds of rooms; `zones`: balconies
- `habits`: tables of objects by place; `clutter`: placement of objects on furniture and on the floor
"""
