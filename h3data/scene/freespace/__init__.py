"""Where one can stand and walk: polygons, distances, shortest paths."""
