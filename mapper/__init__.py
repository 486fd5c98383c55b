"""Maps from recorded RGB-D and LiDAR logs: odometry, pose graph, octree and exports."""

__version__ = "0.1.0"
