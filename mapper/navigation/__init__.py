"""Navigation in a finished map: distance fields, costmaps, the traversable floor, and paths."""
