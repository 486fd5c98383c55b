"""What a robot needs to move in a finished map: distances, costs, the floor it can stand on, and paths."""
