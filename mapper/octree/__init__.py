"""The occupancy octree: updates, queries, its files, and the 2D slice."""
