"""Furniture and small objects, and their placement in a room.

- models: `furniture` (the record and its helpers), `furniture_bath`, `_bed`, `_kitchen`, `_living`; `objects` (small ones)
- placement: `place` (rules), `search` (positions along walls or free-standing), `groups` (furniture that belongs together)
- `clutter`: small objects on receptacles
"""
