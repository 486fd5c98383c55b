"""Errors of depth cameras, measured on planes, and of the line laser, against labels."""
