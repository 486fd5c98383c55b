"""Map recorded RGB-D logs: odometry, pose graph, octree and exports."""

__version__ = "0.1.0"
