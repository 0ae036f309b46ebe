"""Rays through scenes with Embree: lidar, lines of sight, cast shadows, and cameras of other projections.

The package needs the extra ``rays`` for all outputs except colours.
"""

from h3data_rays.engine import HybridEngine
from h3data_rays.rays import Hits, LidarScan, LidarScanner, RayCaster, lidar

__all__ = ["Hits", "HybridEngine", "LidarScan", "LidarScanner", "RayCaster", "lidar"]
