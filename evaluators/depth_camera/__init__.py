"""A depth camera's errors and noise, measured on planes."""
