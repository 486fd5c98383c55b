"""What sensors do to a measurement, and how to undo it."""
