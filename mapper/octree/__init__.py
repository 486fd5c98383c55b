"""The occupancy octree and what is cut from it."""
