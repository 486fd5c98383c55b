"""Units that several formats and messages are in."""

MM_PER_M = 1000.0
MB = 1e6
MIB = 1 << 20
"""Bytes."""
GRAVITY_MPS2 = 9.80665
"""Standard gravity: the unit g of accelerations."""
