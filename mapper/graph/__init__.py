"""The pose graph: its model, its solver, its text form."""
