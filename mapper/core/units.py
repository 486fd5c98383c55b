"""Units that several formats and messages are in."""

MM_PER_M = 1000.0
MB = 1e6
MIB = 1 << 20
"""Bytes."""
GRAVITY_MPS2 = 9.80665
"""Standard gravity: the unit g of accelerations."""

OTHER_UNIT = 2.0
"""Ratio of lengths by frames and by other sensors from which on they have different units: feet have 3.3."""


def unit_of_gravity(length: float) -> float | None:
    """Return the unit in which the length of an acceleration is gravity's, m/s²; None if in no usual one.

    ROS says m/s²; drivers of Livox and Hesai write g, others cm/s² or mg, which nearly are the same.
    """
    units = (1.0, GRAVITY_MPS2, 0.001 * GRAVITY_MPS2)
    return next((unit for unit in units if 0.5 < length * unit / GRAVITY_MPS2 < 2.0), None)
