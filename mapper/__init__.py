"""Maps from recorded RGB-D and LiDAR logs: odometry, pose graph, octree and exports."""

__version__ = "0.2.0"
