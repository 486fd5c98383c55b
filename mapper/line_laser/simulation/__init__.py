"""A room in which a small car with a line laser drives round a block, and what its camera sees of it."""
