"""Subsampling of rows at equal steps."""


def stride_for(count: int, most: int) -> int:
    """Return the smallest step, from the first row on, at which at most so many of the rows are taken."""
    return max(1, -(-count // most))
