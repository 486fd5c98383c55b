"""How work runs: executors, and jobs whose results are kept."""
