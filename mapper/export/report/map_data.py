"""Data of the map in the page: points, voxels and their hits, layers of cells, keyframes and their images."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S, Stamps, nearest
from mapper.export.figures import MARGIN_M
from mapper.export.report.data import Chapter, data_uri, four_digits
from mapper.export.report.packing import Plane, pack_layers, pack_points
from mapper.export.run_maps import snapshots_of
from mapper.mapping.map_building import Snapshot
from mapper.mapping.thumbnails import encode_jpeg
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_BITS, codes_of, codes_of_keys, keys_of
from mapper.octree.map import OctreeMap
from mapper.octree.queries import Leaves
from mapper.octree.ray_casting_kernels import FREE, OCCUPIED
from mapper.octree.scan_updates import open_scan_updates
from mapper.run.folder import Run
from mapper.run.frame_records import stamps_of

NEVER_NS = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Hits of voxels.

    Attributes:
        codes: (N,) int64 Morton codes of the voxels, increasing.
        first_ns: (N,) int64 stamp of the first hit, nanoseconds; the largest integer where there is none.
        hits: (N,) uint32 scans that hit the voxel.
    """

    codes: NDArray[np.int64]
    first_ns: NDArray[np.int64]
    hits: NDArray[np.uint32]

    def coarser(self, levels: int) -> "Observations":
        """Return those of the nodes above the voxels: the earliest stamp, and the most hits of a voxel."""
        parents, starts = np.unique(self.codes >> (3 * levels), return_index=True)
        if not len(parents):
            return self
        return Observations(
            parents,
            np.minimum.reduceat(self.first_ns, starts),
            np.maximum.reduceat(self.hits, starts),
        )

    def of(self, codes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
        """Return the stamp of the first hit and the number of hits of some voxels, in any order."""
        if not len(self.codes):
            return np.full(len(codes), NEVER_NS), np.zeros(len(codes), np.uint32)
        place = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
        is_known = self.codes[place] == codes
        return np.where(is_known, self.first_ns[place], NEVER_NS), np.where(is_known, self.hits[place], 0)


def observations_of(run: Run, codes: NDArray[np.int64]) -> Observations | None:
    """Return the hits of some voxels; None if the run keeps no scan updates.

    Args:
        run: A finished run.
        codes: (N,) int64 Morton codes of the voxels, increasing.

    Raises:
        MapperError: The file of scan updates cannot be read.
    """
    path = run.scan_updates()
    if path is None:
        return None
    blocks, inside = np.unique(codes >> (3 * BLOCK_BITS)), codes & (BLOCK_VOXELS - 1)
    hits = np.zeros((len(blocks), BLOCK_VOXELS), np.uint32)
    first_ns = np.full(hits.shape, NEVER_NS)
    with open_scan_updates(path) as updates:
        for entry in updates.entries():
            update = entry.update()
            _, ours, theirs = np.intersect1d(blocks, update.codes, assume_unique=True, return_indices=True)
            is_hit = np.unpackbits(update.occupied[theirs], axis=1, bitorder="little").astype(np.bool_)
            hits[ours] += is_hit
            first_ns[ours] = np.minimum(first_ns[ours], np.where(is_hit, entry.stamp_ns, NEVER_NS))
    place = np.searchsorted(blocks, codes >> (3 * BLOCK_BITS)), inside
    return Observations(codes, first_ns[place], hits[place])


MOST_POINTS = 2_000_000
"""Points and voxels of one page, over all its runs."""

_MOST_BYTES = 13_000_000  # of the data of one page, as text
_SPARE = 0.97  # fewer points compress a little worse
_MOST_LAYER_BYTES = 4_000_000  # of one page, as text
_MOST_LAYER_CELLS = 100_000_000  # all heights of one run together
_POINT_STEPS = 16  # per voxel of the cloud: 1.3 mm where these are 2 cm
_COLOR_MASK = 0xFC  # six bits of each channel: the two lowest take as much room as the position
_NEVER_SEEN = 1023  # of the steps in which the time of the first hit is given
_HITS_PER_OCTAVE = 16
_MOST_IMAGES = 160
_IMAGE_PX = 256
_MOST_IMAGE_GAP_NS = NS_PER_S // 2


def map_of(chapter: Chapter, *, runs: int = 1, most_points: int = MOST_POINTS) -> dict[str, Any]:
    """Return a run's map, ready for JSON.

    Args:
        chapter: The run.
        runs: Number of runs on the page, which share its limits.
        most_points: Points and voxels of the page.

    Raises:
        MapperError: A file of the run cannot be read.
    """
    run, trajectory = chapter.run, chapter.results.trajectory
    octree = run.octree
    codes = _occupied_codes(octree)
    observed = observations_of(run, codes)
    snapshots = list(snapshots_of(run))
    images = _images(chapter, snapshots)
    has_colors = bool(snapshots) or bool(run.manifest.input.images)
    shown: dict[str, Any] = {
        "voxels": _voxels(
            codes, octree.resolution_m, observed, trajectory.stamps_ns, most=most_points // runs // 2
        ),
        "layers": _layers(octree, most_bytes=_MOST_LAYER_BYTES // runs),
        "is_observed": observed is not None,
        "frames": list(_frames(chapter, [stamp_ns for stamp_ns, _ in images])),
        "images": [data_uri("jpeg", jpeg) for _, jpeg in images],
        "has_north": run.manifest.georeference is not None,
        "headroom_m": four_digits(float(trajectory.positions_world[:, 2].max()) + MARGIN_M),
    }
    most, room = most_points // runs - shown["voxels"]["count"], _MOST_BYTES // runs - len(json.dumps(shown))
    cloud = _cloud(chapter, octree.resolution_m, observed, most=most, has_colors=has_colors)
    while cloud["count"] and len(cloud["data"]) > room:
        most = int(_SPARE * cloud["count"] * max(room, 1) / len(cloud["data"]))
        cloud = _cloud(chapter, octree.resolution_m, observed, most=most, has_colors=has_colors)
    return {"cloud": cloud, **shown}


def map_of_octree(octree: OctreeMap, *, highest_m: float) -> dict[str, Any]:
    """Return a map that has neither a cloud nor frames, ready for JSON: its points are the voxels' centres.

    Args:
        octree: The map.
        highest_m: Height of the highest pose in it.
    """
    codes = _occupied_codes(octree)
    voxels = _voxels(codes, octree.resolution_m, None, np.empty(0, np.int64), most=MOST_POINTS // 2)
    return {
        "cloud": voxels | {"has_colors": False},
        "voxels": voxels,
        "layers": _layers(octree, most_bytes=_MOST_LAYER_BYTES),
        "is_observed": False,
        "frames": [],
        "images": [],
        "headroom_m": four_digits(highest_m + MARGIN_M),
    }


def no_map() -> dict[str, Any]:
    """Return the map of a path that has none, ready for JSON."""
    points = pack_points(np.empty((0, 3)), [], step_m=1.0, most=0) | {"edge_m": 1.0}
    return {
        "cloud": points | {"has_colors": False},
        "voxels": points,
        "layers": None,
        "is_observed": False,
        "frames": [],
        "images": [],
        "headroom_m": None,
    }


def _occupied_codes(octree: OctreeMap) -> NDArray[np.int64]:
    known = octree.leaves()
    return codes_of_keys(known.keys[known.log_odds >= octree.occupied_log_odds].astype(np.int64))


def _voxels(
    codes: NDArray[np.int64],
    resolution_m: float,
    observed: Observations | None,
    stamps_ns: Stamps,
    *,
    most: int,
) -> dict[str, Any]:
    """Return the occupied voxels, or the finest nodes above them that are no more than allowed."""
    levels = 0
    while len(codes) > most:
        codes, levels = np.unique(codes >> 3), levels + 1
    if observed is not None:
        observed = observed.coarser(levels)
    nodes = Leaves(
        keys_of(codes).astype(np.uint16), np.zeros(len(codes), np.float32), resolution_m, KEY_BITS - levels
    )
    planes = _observation_planes(codes, observed, stamps_ns)
    return pack_points(nodes.centres_world, planes, step_m=nodes.edge_m, most=most) | {"edge_m": nodes.edge_m}


def _cloud(
    chapter: Chapter, resolution_m: float, observed: Observations | None, *, most: int, has_colors: bool
) -> dict[str, Any]:
    """Return the coloured cloud; a point has the first hit and the hits of the voxel that it lies in."""
    points_world, colors = chapter.run.cloud.points, chapter.run.cloud.colors
    codes = codes_of(points_world.astype(np.float64), resolution_m)
    planes = _observation_planes(codes, observed, chapter.results.trajectory.stamps_ns)
    if has_colors:
        planes += [np.ascontiguousarray(channel) for channel in (colors & _COLOR_MASK).T]
    edge_m = chapter.run.config.cloud.voxel_m
    packed = pack_points(points_world.astype(np.float64), planes, step_m=edge_m / _POINT_STEPS, most=most)
    return packed | {"edge_m": edge_m, "has_colors": has_colors}


def _observation_planes(
    codes: NDArray[np.int64], observed: Observations | None, stamps_ns: Stamps
) -> list[Plane]:
    """Return the time of the first hit, in steps of the trajectory's time, and the logarithm of the hits."""
    if observed is None:
        return []
    first_ns, hits = observed.of(codes)
    begin_ns, end_ns = int(stamps_ns[0]), int(stamps_ns[-1])
    steps = np.full(len(codes), _NEVER_SEEN, np.uint16)
    is_seen = hits > 0
    share = (first_ns[is_seen] - begin_ns) / max(end_ns - begin_ns, 1)
    steps[is_seen] = np.rint((_NEVER_SEEN - 1) * share.clip(0.0, 1.0))
    octaves = np.rint(_HITS_PER_OCTAVE * np.log2(hits + 1.0)).clip(0, 255)
    return [steps, octaves.astype(np.uint8)]


def _layers(octree: OctreeMap, *, most_bytes: int) -> dict[str, Any]:
    """Return what is free and what is occupied at each height, as fine as the limits allow."""
    for depth in range(KEY_BITS, 0, -1):
        nodes = octree.leaves(depth=depth, parent="max")
        keys = nodes.keys.astype(np.int64)
        low, high = keys.min(axis=0), keys.max(axis=0) + 1
        if np.prod(high - low) > _MOST_LAYER_CELLS:
            continue
        states = np.where(nodes.log_odds >= octree.occupied_log_odds, OCCUPIED, FREE).astype(np.uint8)
        packed = pack_layers(_cells_by_height(keys - low, states, shape=tuple(high - low)))
        if len(packed["data"]) <= most_bytes:
            break
    edge_m = nodes.edge_m
    corner = nodes.centres_world.min(axis=0) - 0.5 * edge_m
    return packed | {"low": corner.tolist(), "edge_m": edge_m, "shape": (high - low).tolist()}


def _cells_by_height(
    cells: NDArray[np.int64], states: NDArray[np.uint8], *, shape: tuple[int, ...]
) -> Iterator[NDArray[np.uint8]]:
    """Yield the cells of each height, lowest first, row 0 having the lowest y."""
    order = np.argsort(cells[:, 2], kind="stable")
    begins = np.searchsorted(cells[order, 2], np.arange(shape[2] + 1))
    for begin, end in pairwise(begins.tolist()):
        layer = np.zeros((shape[1], shape[0]), np.uint8)
        at = order[begin:end]
        layer[cells[at, 1], cells[at, 0]] = states[at]
        yield layer


def _images(chapter: Chapter, snapshots: Sequence[Snapshot]) -> list[tuple[int, bytes]]:
    """Return stamps and small images that are near to keyframes, evenly spread where there are many."""
    if not snapshots:
        return []
    stamps_ns = np.array([snapshot.stamp_ns for snapshot in snapshots])
    keyframes_ns = stamps_of(record for record in chapter.results.records if record.is_keyframe)
    index, gap_ns = nearest(stamps_ns, keyframes_ns)
    used = np.unique(index[gap_ns <= _MOST_IMAGE_GAP_NS])
    if len(used) > _MOST_IMAGES:
        used = used[np.arange(_MOST_IMAGES) * len(used) // _MOST_IMAGES]
    return [(snapshots[k].stamp_ns, _thumbnail(snapshots[k].jpeg)) for k in used.tolist()]


def _thumbnail(jpeg: bytes) -> bytes:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise DataError(
            f"image of {len(jpeg)} bytes in a run's MCAP log: not JPEG; make the log again with mapper fuse"
        )
    return encode_jpeg(image, width_px=_IMAGE_PX)


def _frames(chapter: Chapter, image_stamps_ns: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Yield the numbers of each keyframe and of each doubtful frame that has a pose."""
    results = chapter.results
    place = {stamp_ns: k for k, stamp_ns in enumerate(results.trajectory.stamps_ns.tolist())}
    stamps_ns = np.array(image_stamps_ns, np.int64)
    for record in results.records:
        if record.stamp_ns not in place or not (record.is_keyframe or record.outcome == "doubtful"):
            continue
        how = record.diagnostics
        image = None
        if len(stamps_ns):
            index, gap_ns = nearest(stamps_ns, np.array([record.stamp_ns]))
            image = int(index[0]) if gap_ns[0] <= _MOST_IMAGE_GAP_NS else None
        yield {
            "pose": place[record.stamp_ns],
            "node": record.node if record.is_keyframe else None,
            "features": how.features,
            "matches": how.matches,
            "inliers": how.inliers,
            "residual": four_digits(how.residual),
            "residual_unit": how.residual_unit,
            "method": how.method,
            "doubts": [doubt.text for doubt in record.doubts],
            "ms": four_digits(results.frame_ms.get(record.stamp_ns)),
            "image": image,
        }
