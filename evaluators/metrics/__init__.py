"""Numbers that say how good a trajectory, a map, loops or a registration is."""
