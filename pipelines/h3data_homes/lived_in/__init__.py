"""Homes of the second generation: styles, rooms and things left lying around.

- `looks`: eight styles; `models`: furniture of the first generation with other looks, on the same footprint; `pictures`
- `rooms`: what is added to each kind of room, and the new kinds of rooms; `zones`: balconies
- `habits`: tables of what lies where; `clutter`: things on furniture and on the floor
"""
