"""Loop closure: candidates for places seen before, their verification, and their verdicts."""
