"""GNSS fixes beside a log: ``gnss.txt``, sentences of NMEA 0183, or ``oxts`` of KITTI's raw drives."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import FARTHEST_M, Array
from mapper.core.timebase import seconds_text_from_ns
from mapper.runtime.atomic import write_text
from mapper.sensing.gnss import NO_FIX, GnssFixes
from mapper.sources.kitti_calibration import pose_beside
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.nmea import fixes_from_sentences
from mapper.sources.text import parse_date, parse_numbers, parse_stamp, read_lines, rows, time_order

FIXES, OXTS = "gnss.txt", "oxts"
_ANTENNA = "antenna"
_COLUMNS, _WITH_COVARIANCE = 5, 11
_UPPER = np.triu_indices(3)
_OXTS_COLUMNS, _ACCURACY, _POSITION_MODE = 30, 23, 28
_VERTICAL_RATIO = 2.0
"""OXTS states one accuracy; heights are about twice as inaccurate (GPS SPS performance standard, 2020: 8 m
horizontally and 13 m vertically at 95 %)."""
_LEAST_MODE, _AUGMENTED_MODES = 3, {4: 2, 5: 2, 6: 2, 7: 1, 8: 2}
"""OXTS's modes: below 3 there is no position, 3 is plain, 4 differential, 5 and 6 RTK, 7 SBAS."""


def read_gnss(folder: Path) -> tuple[GnssFixes | None, list[str]]:
    """Return the fixes of a log's folder, if it has any, and notes.

    Args:
        folder: Folder that may hold ``gnss.txt``, lines of ``stamp latitude_deg longitude_deg height_m
            status``, to which the upper triangle of the covariance of east, north and up (m²) may be added,
            after an optional line ``antenna x y z`` (metres, body frame); ``oxts/data/*.txt`` with
            ``oxts/timestamps.txt`` (Geiger et al. 2013); or a file ``.nmea`` of a receiver's sentences.

    Raises:
        SourceError: A file is malformed.
    """
    if (folder / FIXES).is_file():
        return _read_table(folder / FIXES)
    if (folder / OXTS / "timestamps.txt").is_file():
        return _read_oxts(folder / OXTS)
    for path in sorted(folder.glob("*.nmea"))[:1]:
        fixes, notes = fixes_from_sentences(path.name, ((None, line) for line in read_lines(path)))
        kept, more = (None, []) if fixes is None else in_order(fixes)
        return kept, [*notes, *more]
    return None, []


def write_gnss(folder: Path, fixes: GnssFixes) -> None:
    """Write fixes as the ``gnss.txt`` of a log."""
    lines = ["# timestamp latitude_deg longitude_deg height_m status ee en eu nn nu uu"]
    if fixes.antenna_body is not None:
        lines.append(" ".join([_ANTENNA, *map(repr, fixes.antenna_body.tolist())]))
    for stamp_ns, place, status, covariance in zip(
        fixes.stamps_ns.tolist(),
        fixes.geodetic.tolist(),
        fixes.status.tolist(),
        fixes.covariances_enu[:, *_UPPER].tolist(),
        strict=True,
    ):
        numbers = [*map(repr, place), str(status), *map(repr, covariance)]
        lines.append(" ".join([seconds_text_from_ns(stamp_ns), *numbers]))
    write_text(folder / FIXES, "\n".join(lines) + "\n")


def _read_table(path: Path) -> tuple[GnssFixes | None, list[str]]:
    antenna_body: Array | None = None
    stamps_ns, numbers = [], []
    for number, words in rows(path):
        where = f"{path}:{number}"
        if words[0] == _ANTENNA and len(words) == 4:
            antenna_body = parse_numbers(words[1:], where=where)
            continue
        if len(words) not in (_COLUMNS, _WITH_COVARIANCE):
            raise SourceError(
                f"{where}: {len(words)} columns, want {_COLUMNS} (stamp latitude longitude height status) "
                f"or {_WITH_COVARIANCE}, with the covariance"
            )
        stamps_ns.append(parse_stamp(words[0], where=where))
        row = parse_numbers(words[1:], where=where)
        numbers.append(np.pad(row, (0, _WITH_COVARIANCE - 1 - len(row)), constant_values=np.nan))
    table = np.array(numbers, np.float64).reshape(-1, _WITH_COVARIANCE - 1)
    covariances = np.empty((len(table), 3, 3))
    covariances[:, *_UPPER] = covariances[:, *_UPPER[::-1]] = table[:, 4:]
    status = np.where(np.isfinite(table[:, 3]), table[:, 3], NO_FIX).clip(NO_FIX, 2).astype(np.int8)
    stamps = np.array(stamps_ns, np.int64)
    return in_order(GnssFixes(path.name, stamps, table[:, :3], covariances, status, antenna_body))


def in_order(fixes: GnssFixes) -> tuple[GnssFixes | None, list[str]]:
    """Return fixes in order of time that are positions, None if there are none, and notes on the others."""
    order, notes = time_order(fixes.stamps_ns, what=fixes.name)
    kept, more = fixes.of(order).without_invalid()
    return kept, [*notes, *more]


def _read_oxts(folder: Path) -> tuple[GnssFixes | None, list[str]]:
    """Return the positions of a raw drive's inertial navigation system; its origin counts as the antenna."""
    stamps_ns = [
        parse_date(line.strip(), where=f"{folder / 'timestamps.txt'}:{number}")
        for number, line in enumerate(read_lines(folder / "timestamps.txt"), start=1)
        if line.strip()
    ]
    files = sorted((folder / "data").glob("*.txt"))
    refuse_links_out(files, log=folder.parent)
    by_number = [(int(file.stem), file) for file in files if file.stem.isdecimal()]
    paired = [(stamps_ns[number], file) for number, file in by_number if number < len(stamps_ns)]
    readings = np.array(list(_oxts_rows(file for _, file in paired))).reshape(-1, _OXTS_COLUMNS)
    accuracy_m = np.minimum(readings[:, _ACCURACY], FARTHEST_M)
    modes = readings[:, _POSITION_MODE].astype(int)
    variances = np.square(accuracy_m[:, None] * [1.0, 1.0, _VERTICAL_RATIO])
    T_lidar_imu = pose_beside(folder.parent, "calib_imu_to_velo.txt")
    status = [NO_FIX if mode < _LEAST_MODE else _AUGMENTED_MODES.get(mode, 0) for mode in modes.tolist()]
    return in_order(
        GnssFixes(
            OXTS,
            np.array([stamp_ns for stamp_ns, _ in paired], np.int64),
            readings[:, :3],
            variances[:, :, None] * np.eye(3),
            np.array(status, np.int8),
            None if T_lidar_imu is None else T_lidar_imu[:3, 3],
        )
    )


def _oxts_rows(files: Iterable[Path]) -> Iterator[Array]:
    for file in files:
        lines = read_lines(file)
        words = lines[0].split() if lines else []
        if len(words) != _OXTS_COLUMNS:
            raise SourceError(f"{file}: {len(words)} numbers, want the {_OXTS_COLUMNS} of OXTS")
        yield np.nan_to_num(parse_numbers(words, where=f"{file}"))
