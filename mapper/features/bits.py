"""Counting bits, which comparing binary descriptors comes down to."""

from numba.extending import intrinsic


@intrinsic
def popcount(_context, x):  # type: ignore[no-untyped-def]
    """Count the set bits of a uint64 with the processor's own instruction, which numba does not expose."""

    def generate(_typing, builder, _signature, arguments):  # type: ignore[no-untyped-def]
        return builder.ctpop(arguments[0])

    return x(x), generate
