"""Pictures and recordings of evaluations."""
