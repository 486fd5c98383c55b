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
    """Return the unit in which the length of an acceleration is gravity's: 1 m/s² or g; None if in neither.

    ROS says m/s²; drivers of Livox and Hesai write g.
    """
    units = (unit for unit in (1.0, GRAVITY_MPS2) if 0.5 < length * unit / GRAVITY_MPS2 < 2.0)
    return next(units, None)
