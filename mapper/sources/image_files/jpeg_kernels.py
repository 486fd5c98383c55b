"""Kernels that read the Huffman codes of a baseline JPEG's scan (ITU-T T.81, Annex F.2)."""

import numpy as np
from numba import int64, njit, uint64
from numpy.typing import NDArray

WHOLE, UNKNOWN_CODE, LONG_RUN, TOO_LARGE, ENDS_EARLY, UNREAD, NO_RESTART = range(7)

LONGEST_CODE = 16
"""Bits of the longest Huffman code."""
_LOOKUP_BITS = 11
_MOST_DC_BITS, _MOST_AC_BITS = 11, 10  # of a coefficient of 8-bit samples
_PADDING = 512
"""Zeros behind coded data, more than the bytes of the longest block: one of 64 codes of 26 bits."""


@njit(cache=True, nogil=True)
def read_scan(
    data: NDArray[np.uint8],
    at: int,
    mcus: int,
    interval: int,
    component_of: NDArray[np.int64],
    counts: NDArray[np.uint8],
    symbols: NDArray[np.uint8],
    most_dc: NDArray[np.int64],
) -> tuple[int, int, int]:
    """Read the codes of a scan.

    Args:
        data: (N,) the file.
        at: Index at which the coded data start.
        mcus: Minimum coded units in the scan.
        interval: Number of units between two restart markers; 0 for none.
        component_of: (B,) of the scan's C components, which each block of a unit belongs to.
        counts: (2 C, 16) codes of each length in every component's tables, of DC and of AC.
        symbols: (2 C, 256) symbols of these codes.
        most_dc: (C,) largest absolute DC coefficient, in quantisation steps.

    Returns:
        What is wrong or ``WHOLE``, the unit at which it was found, and where the data end.
    """
    tables = counts.shape[0]
    lookup = np.empty((tables, 1 << _LOOKUP_BITS), np.int32)
    last_codes = np.empty((tables, LONGEST_CODE + 1), np.int64)
    offsets = np.empty((tables, LONGEST_CODE + 1), np.int64)
    for t in range(tables):
        _fill_table(counts[t], symbols[t], t % 2 == 1, lookup[t], last_codes[t], offsets[t])
    coded = np.empty(data.size - at + _PADDING, np.uint8)
    predicted = np.zeros(len(most_dc), np.int64)
    mcu = restarts = 0
    while True:
        size, at = _unstuffed(data, at, coded)
        coded[size : size + _PADDING] = 0
        end = mcus if interval == 0 else min(mcu + interval, mcus)
        predicted[:] = 0
        fault, mcu, bits = _read_units(
            coded,
            size,
            mcu,
            end,
            component_of,
            lookup,
            last_codes,
            offsets,
            symbols,
            most_dc,
            predicted,
        )
        if fault != WHOLE:
            return fault if bits <= 8 * size else ENDS_EARLY, mcu, at
        if not _is_padding(coded, bits, size):
            return UNREAD, mcu, at
        if mcu == mcus:
            return WHOLE, mcu, at
        if at + 1 >= data.size or data[at + 1] != 0xD0 + restarts % 8:
            return NO_RESTART, mcu, at
        at += 2
        restarts += 1


@njit(cache=True, nogil=True)
def _unstuffed(data: NDArray[np.uint8], at: int, coded: NDArray[np.uint8]) -> tuple[int, int]:
    """Copy coded data up to the next marker without stuffed zeros; return their size and where it is."""
    size = 0
    while at < data.size:
        value = data[at]
        coded[size] = value
        if value == 0xFF:
            behind = at + 1
            # A marker, or a value, may follow more than one.
            while behind < data.size and data[behind] == 0xFF:
                behind += 1
            if behind == data.size or data[behind] != 0:
                return size, behind - 1
            at = behind
        size += 1
        at += 1
    return size, at


@njit(cache=True, nogil=True)
def _is_padding(coded: NDArray[np.uint8], bits: int, size: int) -> bool:
    """Return whether the last bit read is followed by padding: part of a byte, or bytes that cameras add."""
    first = (bits + 7) >> 3
    zeros = ones = True
    for i in range(first, size):
        zeros &= coded[i] == 0
        ones &= coded[i] == 0xFF
    return zeros or ones


@njit(cache=True, nogil=True)
def _fill_table(
    counts: NDArray[np.uint8],
    symbols: NDArray[np.uint8],
    is_ac: bool,
    lookup: NDArray[np.int32],
    last_codes: NDArray[np.int64],
    offsets: NDArray[np.int64],
) -> None:
    """Fill a table of what the next bits mean, 0 for longer codes and none, and last codes by length."""
    lookup[:] = 0
    code = first = 0
    for length in range(1, LONGEST_CODE + 1):
        count = int64(counts[length - 1])
        offsets[length] = first - code
        last_codes[length] = code + count - 1 if count else -1
        if length <= _LOOKUP_BITS:
            width = 1 << (_LOOKUP_BITS - length)
            for i in range(count):
                low = (code + i) * width
                lookup[low : low + width] = _entry(length, int64(symbols[(first + i) & 255]), is_ac)
        first += count
        code = (code + count) << 1


@njit(cache=True, nogil=True)
def _entry(length: int, symbol: int, is_ac: bool) -> int:
    """Return what a code means: bits of code and value (5), of the code (5), of the value (4), zeros (4).

    0 is what no code may mean; all but the lowest 10 bits are 0 for the end of a block.
    """
    run, bits = (symbol >> 4, symbol & 15) if is_ac else (0, symbol)
    if bits > (_MOST_AC_BITS if is_ac else _MOST_DC_BITS):
        return 0
    if is_ac and bits == 0 and run not in (0, 15):
        return 0
    return (length + bits) | length << 5 | bits << 10 | run << 14


@njit(cache=True, nogil=True)
def _long_entry(
    window: int,
    symbols: NDArray[np.uint8],
    is_ac: bool,
    last_codes: NDArray[np.int64],
    offsets: NDArray[np.int64],
) -> int:
    """Return what the code means that the next bits, the window's highest, begin with; 0 if it is none."""
    for length in range(1, LONGEST_CODE + 1):
        code = int64(uint64(window) >> uint64(64 - length))
        if code <= last_codes[length]:
            entry: int = _entry(length, int64(symbols[(code + offsets[length]) & 255]), is_ac)
            return entry
    return 0


@njit(nogil=True, inline="always")
def _value(window: int, entry: int) -> int:
    """Return the value behind a code: the window's highest bits are the code and then those of the value."""
    bits = (entry >> 10) & 15
    rest = uint64(window) << uint64((entry >> 5) & 31)
    is_negative = ~(int64(rest) >> 63)  # all ones if the first bit is 0
    value: int = int64((rest >> uint64(63 - bits)) >> uint64(1)) - (is_negative & ((1 << bits) - 1))
    return value


@njit(nogil=True, inline="always")
def _word(coded: NDArray[np.uint8], at: int) -> int:
    """Return four bytes as the highest bits of a window of 64."""
    i = uint64(at)
    word: int = (
        uint64(coded[i]) << uint64(56)
        | uint64(coded[i + uint64(1)]) << uint64(48)
        | uint64(coded[i + uint64(2)]) << uint64(40)
        | uint64(coded[i + uint64(3)]) << uint64(32)
    )
    return word


@njit(cache=True, nogil=True)
def _read_units(
    coded: NDArray[np.uint8],
    size: int,
    mcu: int,
    end: int,
    component_of: NDArray[np.int64],
    lookup: NDArray[np.int32],
    last_codes: NDArray[np.int64],
    offsets: NDArray[np.int64],
    symbols: NDArray[np.uint8],
    most_dc: NDArray[np.int64],
    predicted: NDArray[np.int64],
) -> tuple[int, int, int]:
    """Read units up to ``end``; return what is wrong, the unit at which it is, and the bits read."""
    window, held, at = uint64(0), 0, 0  # the next bits, highest first, and how many of them are held
    for unit in range(mcu, end):
        for c in component_of:
            dc, ac = 2 * c, 2 * c + 1
            if held < 32:
                window |= _word(coded, at) >> uint64(held)
                at, held = at + 4, held + 32
            entry = int64(lookup[dc, window >> uint64(64 - _LOOKUP_BITS)])
            if entry == 0:
                entry = _long_entry(window, symbols[dc], False, last_codes[dc], offsets[dc])
                if entry == 0:
                    return UNKNOWN_CODE, unit, 8 * at - held
            predicted[c] += _value(window, entry)
            window <<= uint64(entry & 31)
            held -= entry & 31
            if abs(predicted[c]) > most_dc[c]:
                return TOO_LARGE, unit, 8 * at - held
            k = 1
            while k < 64:
                if held < 32:
                    window |= _word(coded, at) >> uint64(held)
                    at, held = at + 4, held + 32
                entry = int64(lookup[ac, window >> uint64(64 - _LOOKUP_BITS)])
                if entry == 0:
                    entry = _long_entry(window, symbols[ac], True, last_codes[ac], offsets[ac])
                    if entry == 0:
                        return UNKNOWN_CODE, unit, 8 * at - held
                window <<= uint64(entry & 31)
                held -= entry & 31
                if entry < 1024:
                    break
                k += entry >> 14
                if k > 63:
                    return LONG_RUN, unit, 8 * at - held
                k += 1
            if 8 * at - held > 8 * size:
                return ENDS_EARLY, unit, 8 * at - held
    return WHOLE, end, 8 * at - held
