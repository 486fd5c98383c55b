"""Messages in time order even where stamps are damaged or a clock was set, and colour paired with depth."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from mapper.core.errors import SourceError
from mapper.core.timebase import NS_PER_S, Stamps, nearest
from mapper.sources.image_folders.rgbd import unpaired_note
from mapper.sources.ros.message_index import Series
from mapper.sources.text import time_order

_Indices = NDArray[np.intp]

_NEIGHBOURS = 5
_MAX_STRAY_NS = NS_PER_S
"""A stamp further from the median of itself and its neighbours is damaged: even where frames are lost."""
_SET_FORWARD_S = 10.0
"""Stamps that advance by so much more than the times of recording are of a clock that was set."""
_SAME_DELAY_S = 0.25
"""Times of recording are later than stamps by what drivers take, of one camera's images about the same."""
_STOPPED_S = 1.0
_MAX_OVERTAKEN = 4
"""Messages that may follow one they should have preceded; more say that the clock was set back."""


def ordered(series: Series) -> tuple[_Indices, list[str]]:
    """Return a topic's messages in strictly increasing time, and notes on those left out."""
    name = series.topic.name
    sound, notes = _sound(series)
    stamps_ns = series.stamps_ns[sound]
    kept = _without_overlap(stamps_ns, _epochs(stamps_ns))
    notes += _overlap_note(name, int((~kept).sum()), len(kept))
    sound = sound[kept]
    order, order_notes = time_order(series.stamps_ns[sound], what=name)
    return sound[order], [*notes, *order_notes]


def paired(
    color: Series, depth: Series, *, max_gap_s: float, where: str
) -> tuple[_Indices, _Indices, list[str]]:
    """Return each colour image with its nearest depth image, in strictly increasing time, and notes.

    A clock that was set back lets two images bear the same stamp and show different places; images are
    paired only if the clock had been set back equally often before them.

    Raises:
        SourceError: Nothing pairs.
    """
    max_gap_ns = round(max_gap_s * NS_PER_S)
    sound_color, notes = _sound(color)
    sound_depth, depth_notes = _sound(depth)
    notes += depth_notes
    epochs_color, epochs_depth = (
        _epochs(one.stamps_ns[sound]) for one, sound in ((color, sound_color), (depth, sound_depth))
    )
    pairs_color, pairs_depth, closest_ns = [], [], []
    for epoch in np.intersect1d(epochs_color, epochs_depth):
        of_color = sound_color[epochs_color == epoch]
        of_depth = sound_depth[epochs_depth == epoch]
        of_depth = of_depth[np.argsort(depth.stamps_ns[of_depth], kind="stable")]
        partner, gap_ns = nearest(depth.stamps_ns[of_depth], color.stamps_ns[of_color])
        is_near = gap_ns <= max_gap_ns
        pairs_color.append(of_color[is_near])
        pairs_depth.append(of_depth[partner[is_near]])
        closest_ns.append(int(gap_ns.min()))
    i, j = np.concatenate(pairs_color), np.concatenate(pairs_depth)
    if len(i) == 0:
        raise SourceError(
            f"{where}: no image of {color.topic.name} has one of {depth.topic.name} within "
            f"{max_gap_s * 1e3:g} ms; the closest are {min(closest_ns) / NS_PER_S:g} s apart "
            f"({'; '.join(['source.max_pair_gap_s', *_clock_note(color, depth)])})"
        )
    notes += unpaired_note(len(sound_color) - len(i), len(sound_color), max_gap_s=max_gap_s)
    notes += [*_end_note(color, depth), *_clock_note(color, depth)]
    kept = _without_overlap(color.stamps_ns[i], _epochs(color.stamps_ns[i]))
    notes += _overlap_note(color.topic.name, int((~kept).sum()), len(kept))
    i, j = i[kept], j[kept]
    order, order_notes = time_order(color.stamps_ns[i], what=color.topic.name)
    return i[order], j[order], [*notes, *order_notes]


def _sound(series: Series) -> tuple[_Indices, list[str]]:
    """Return the messages whose stamps agree with their neighbours', and a note on the others."""
    stamps_ns = series.stamps_ns
    is_sound = np.ones(len(stamps_ns), dtype=bool)
    if len(stamps_ns) >= _NEIGHBOURS:
        windows = np.sort(sliding_window_view(stamps_ns, _NEIGHBOURS), axis=1)
        inner = slice(_NEIGHBOURS // 2, len(stamps_ns) - _NEIGHBOURS // 2)
        off_ns = np.abs(stamps_ns[inner].astype(np.float64) - windows[:, _NEIGHBOURS // 2])
        is_sound[inner] = off_ns <= _MAX_STRAY_NS
    notes = []
    if series.restamped:
        notes.append(
            f"{series.topic.name}: {series.restamped} of {len(stamps_ns)} headers have no stamp of their "
            "own; the times of recording are taken"
        )
    if wrong := series.undated + int((~is_sound).sum()):
        notes.append(
            f"{series.topic.name}: {wrong} of {len(stamps_ns) + series.undated} messages have stamps that "
            "cannot be right; left out"
        )
    sound = np.flatnonzero(is_sound)
    ahead_s = (np.diff(stamps_ns[sound]) - np.diff(series.log_ns[sound])) / NS_PER_S
    notes += [
        f"{series.topic.name}: the clock was set forward by {ahead_s[k]:.1f} s while recording, before "
        f"message {sound[k + 1]}: map the parts apart (source.first_frame, source.last_frame)"
        for k in np.flatnonzero((ahead_s > _SET_FORWARD_S) & (np.ptp(series.log_ns) > 0))[:1].tolist()
    ]
    return sound, notes


def _epochs(stamps_ns: Stamps) -> NDArray[np.int64]:
    """Return how often the clock had been set back before each message, in the order of recording."""
    before = stamps_ns[:-1]
    later = stamps_ns[np.minimum(np.arange(1, len(stamps_ns)) + _MAX_OVERTAKEN, len(stamps_ns) - 1)]
    was_set_back = (stamps_ns[1:] < before) & (later < before)
    return np.concatenate([[0], np.cumsum(was_set_back)])


def _without_overlap(stamps_ns: Stamps, epochs: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which messages to keep: the largest epoch, and of the others what lies before or after it."""
    sizes = np.bincount(epochs)
    main = int(sizes.argmax())
    kept: NDArray[np.bool_] = epochs == main
    low_ns, high_ns = stamps_ns[kept].min(), stamps_ns[kept].max()
    for epoch in range(main + 1, len(sizes)):
        later = (epochs == epoch) & (stamps_ns > high_ns)
        kept |= later
        high_ns = stamps_ns[later].max(initial=high_ns)
    for epoch in reversed(range(main)):
        earlier = (epochs == epoch) & (stamps_ns < low_ns)
        kept |= earlier
        low_ns = stamps_ns[earlier].min(initial=low_ns)
    return kept


def _overlap_note(name: str, dropped: int, total: int) -> Sequence[str]:
    if not dropped:
        return []
    return [
        f"{name}: the clock was set back while recording; {dropped} of {total} frames bear times that other "
        "frames have too; left out"
    ]


def _end_note(color: Series, depth: Series) -> Sequence[str]:
    """Return a note if one topic stopped before the other, by the clock of the recorder."""
    first, last = sorted((color, depth), key=lambda series: int(series.log_ns[-1]))
    early_s = (int(last.log_ns[-1]) - int(first.log_ns[-1])) / NS_PER_S
    if early_s <= _STOPPED_S:
        return []
    return [f"{first.topic.name} stops {early_s:.1f} s before {last.topic.name}"]


def _clock_note(color: Series, depth: Series) -> Sequence[str]:
    """Return a note if the stamps of two topics differ from the recorder's clock by different times."""
    late_s = (color.clock_ns - depth.clock_ns) / NS_PER_S
    if abs(late_s) <= _SAME_DELAY_S:
        return []
    return [
        f"by the times of recording {depth.topic.name} is {late_s:.3g} s later than its stamps, if "
        f"{color.topic.name} is not; source.depth_offset_s={late_s:.3g} moves depth"
    ]
