"""Free floor on which agents can stand and walk: polygons, distances, shortest paths."""
