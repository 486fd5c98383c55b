"""Loop closure: who might be the same place, whether it is, and what was made of it."""
