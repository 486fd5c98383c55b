"""Pairs of colour and depth images that are files, by their stamps."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.timebase import NS_PER_S, Stamps, nearest
from mapper.sources.base import ImageFile
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.rgbd import FramePair, unpaired_note
from mapper.sources.listed_files import present
from mapper.sources.text import time_order


@dataclass(frozen=True, slots=True, eq=False)
class ImageList:
    """Images of one kind.

    Attributes:
        stamps_ns: (N,) increasing.
        paths: Their files.
    """

    stamps_ns: Stamps
    paths: Sequence[ImageFile]

    @classmethod
    def in_time(
        cls, stamps_ns: Stamps | Sequence[int], paths: Sequence[ImageFile], *, what: str
    ) -> tuple[Self, list[str]]:
        """Return images of any order by their stamps, and notes on what that changed in ``what``."""
        stamps = np.asarray(stamps_ns, np.int64)
        order, notes = time_order(stamps, what=what)
        return cls(stamps[order], [paths[i] for i in order]), notes


def usable_pairs(
    pairs: Sequence[FramePair], config: SourceConfig, *, listed_in: Path
) -> tuple[Sequence[FramePair], list[str]]:
    """Return the pairs of a list whose two images exist, as of ``ordered_pairs``, and notes on the others.

    Raises:
        SourceError: No pair has both images, or ``source.depth_offset_s`` leaves none.
    """
    has_colour = present(Path(f"{pair.colour}") for pair in pairs)
    has_depth = present(Path(f"{pair.depth}") for pair in pairs)
    kept = [pair for pair, *has in zip(pairs, has_colour, has_depth, strict=True) if all(has)]
    if not kept:
        raise SourceError(
            f"{listed_in}: none of its {len(pairs)} pairs of images exists; the first: {pairs[0].colour}"
        )
    notes = []
    if dropped := len(pairs) - len(kept):
        notes.append(f"{listed_in.name}: {dropped} of {len(pairs)} listed pairs do not exist; dropped")
    ordered, order_notes = ordered_pairs(kept, config, what=listed_in.name, path=listed_in)
    return ordered, [*notes, *order_notes]


def ordered_pairs(
    pairs: Sequence[FramePair], config: SourceConfig, *, what: str, path: Path
) -> tuple[Sequence[FramePair], list[str]]:
    """Return a format's own pairs in time order, the first of equal stamps only, and notes on what changed.

    If ``source.depth_offset_s`` shifts the depth images, pairs are found again among them.

    Args:
        pairs: The pairs.
        config: Offset of the depth images, and how far the two of a pair may be apart.
        what: Source of the stamps, for the notes.
        path: Log, for the error.

    Raises:
        SourceError: The offset leaves no pairs.
    """
    all_ns = np.array([pair.stamp_ns for pair in pairs], dtype=np.int64)
    order, notes = time_order(all_ns, what=what)
    ordered = [pairs[i] for i in order]
    if depth_offset_ns(config) == 0:
        return ordered, notes
    colour = ImageList(all_ns[order], [pair.colour for pair in ordered])
    stamps_ns, first = np.unique([pair.depth_stamp_ns for pair in ordered], return_index=True)
    depth = ImageList(stamps_ns, [ordered[i].depth for i in first])
    found, more = pair_images(colour, depth, config, path=path)
    return found, [*notes, *more]


def depth_offset_ns(config: SourceConfig) -> int:
    """Return what is added to the stamps of depth images, nanoseconds."""
    return round((config.depth_offset_s or 0.0) * NS_PER_S)


def pair_images(
    colour: ImageList,
    depth: ImageList,
    config: SourceConfig,
    *,
    path: Path,
    names: tuple[str, str] = ("colour", "depth"),
) -> tuple[list[FramePair], list[str]]:
    """Return each colour image with the nearest depth image, and a note on those that have none.

    Depth images are ``source.depth_offset_s`` later than their stamps, and at most ``source.max_pair_gap_s``
    from a colour image. ``names`` are those of the two kinds of images in messages.

    Raises:
        SourceError: Nothing pairs.
    """
    max_gap_s, depth_stamps_ns = config.max_pair_gap_s, depth.stamps_ns + depth_offset_ns(config)
    partner, gap_ns = nearest(depth_stamps_ns, colour.stamps_ns)
    paired = np.flatnonzero(gap_ns <= round(max_gap_s * NS_PER_S))
    if len(paired) == 0:
        remedy, first_s = "source.max_pair_gap_s", int(colour.stamps_ns[0] - depth.stamps_ns[0]) / NS_PER_S
        if gap_ns.min() > NS_PER_S and names[1] == "depth":
            remedy = f"another clock? source.depth_offset_s={first_s:.3f} lets both begin together"
        raise SourceError(
            f"{path}: no {names[0]} image has a {names[1]} image within {max_gap_s * 1e3:g} ms; "
            f"the closest pair is {int(gap_ns.min()) / NS_PER_S:g} s apart ({remedy})"
        )
    pairs = [
        FramePair(
            stamp_ns=int(colour.stamps_ns[i]),
            colour=colour.paths[int(i)],
            depth_stamp_ns=int(depth_stamps_ns[partner[i]]),
            depth=depth.paths[int(partner[i])],
        )
        for i in paired
    ]
    return pairs, unpaired_note(len(gap_ns) - len(pairs), len(gap_ns), max_gap_s=max_gap_s, names=names)
