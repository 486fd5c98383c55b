"""Functions of ``import mapper`` that take paths, arrays and plain values."""
