"""Every method on one log, side by side."""
