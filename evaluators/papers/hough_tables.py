"""Table 1 of Nagy, Gálai & Benedek (2016) as printed, and ours in its layout.

Their clouds are not public, so ours are other scenes. Single scenes do not compare; how often the method
succeeds, how near it ends and how long it takes do.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean, median

from mapper.evaluators.papers.hough import DISTANCES, METHODS, OFFSET_M, picture_of
from mapper.evaluators.papers.hough_pairs import (
    ALL_RINGS,
    EXTRINSIC_DEG,
    EXTRINSIC_M,
    FEW_RINGS,
    MAP_VOXEL_M,
    RIGHT_DEG,
    RIGHT_M,
)
from mapper.evaluators.papers.model import PaperCell, PaperTable, Reproduction
from mapper.evaluators.papers.published import published
from mapper.evaluators.tables.table import Record, Value
from mapper.runtime.resumable_jobs import JobResult

NEAR_M = 0.03
"""A final MPD below it is the paper's success."""
FAILED_SCENE = "Bajcsy"
"""The one scene that its authors found to be wrong, with either sensor."""

_PAPER = "Nagy, Gálai, Benedek: Multimodális pontfelhőregisztráció Hough tér alapú előillesztéssel (2016)"
_KEYS = ("offset_m", "yaw_deg", *DISTANCES, "seconds")
_COLUMNS = (
    *("offset, m", "yaw, °"),
    *(f"{measure} {stage}, m" for measure in ("MHD", "MPD") for stage in ("input", "Hough", "final")),
    "time, s",
)
_ERRORS = {
    "error_m": "error, m",
    "error_deg": "error, °",
    "mpd_final_m": "MPD final, m",
    "mpd_truth_m": "MPD at the truth, m",
}
_PRINTED_AS = {ALL_RINGS: "HDL", FEW_RINGS: "VLP", "HDL": "HDL", "VLP": "VLP"}

Trials = Sequence[Record]


def hough_reproduction(results: Iterable[JobResult], *, pictures: Path) -> Reproduction:
    """Return both summed up, the printed table, ours in its layout by each method, and our errors.

    Args:
        results: Results of the jobs of :func:`~mapper.evaluators.papers.hough.hough_jobs`.
        pictures: Folder of their pictures.
    """
    results = list(results)
    trials = [record for result in results for record in result.records]
    return Reproduction(
        paper=_PAPER,
        tables=(
            _summary(trials),
            _as_printed(),
            *(_in_layout(trials, method) for method in METHODS),
            _against_truth(trials),
        ),
        seeds=len({trial["seed"] for trial in trials}),
        notes=(
            "our scenes are not the paper's, so only the summary compares; all rings stand beside its "
            "HDL-64E, 16 rings, every fourth of 64, beside its VLP-16",
            f"each seed turns a scan by any yaw and sets it off by up to {OFFSET_M:g} m",
            "a log's map is made of the scans around the one left out, one point per "
            f"{100 * MAP_VOXEL_M:g} cm voxel: sparser than the paper's mobile mapping, but of the same drive",
            f"wrong: {RIGHT_M:g} m or {RIGHT_DEG:g}° off the truth; {EXTRINSIC_M:g} m or {EXTRINSIC_DEG:g}° "
            "where that is an extrinsic calibration; not trusted: the method itself says so",
            "time: CPU time of the whole registration on this machine, the map's preparation included",
            *(f"failed: {result.label}: {result.failure}" for result in results if result.failure),
        ),
        pictures=tuple(
            path
            for group in _grouped(trials, "pair", "sensor", "method")
            if (path := picture_of(pictures, ", ".join(map(str, group)))).is_file()
        ),
    )


def _summary(trials: Trials) -> PaperTable:
    """Return how often, how near and how fast, over the pairs of a sensor: one figure per seed."""
    cells, notes = [], []
    for (sensor, method), of_both in _grouped(trials, "sensor", "method").items():
        row, printed = f"{sensor}, {method}", _printed_sums(str(sensor))
        for column, summed in _SUMS.items():
            known = [summed(of_seed) for of_seed in _grouped(of_both, "seed").values()]
            ours = tuple(figure for figure in known if figure is not None)
            cells.append(PaperCell(row, column, printed.get(column), ours))
        pairs = _grouped(of_both, "pair").values()
        final, at_truth = (_near_of(pairs, key) for key in ("mpd_final_m", "mpd_truth_m"))
        notes.append(
            f"{row}: MPD below {100 * NEAR_M:g} cm in {final} pairs, at the truth itself in {at_truth}"
        )
    title = "theirs and ours over all scenes of a sensor"
    return _table(
        "Table 1, summary", title, cells, (f"printed as wrong, with either sensor: {FAILED_SCENE}", *notes)
    )


def _near_of(pairs: Collection[Trials], key: str) -> str:
    """Return in how many of the pairs for which a distance is known its median is small."""
    medians = [median(known) for pair in pairs if (known := _known(pair, key))]
    return f"{sum(distance_m < NEAR_M for distance_m in medians)} of {len(medians)}"


def _share_without(key: str) -> Callable[[Trials], float | None]:
    """Return the percentage of trials in which a flag is not set, of those for which it is known."""
    return lambda trials: 100.0 * (1.0 - mean(known)) if (known := _known(trials, key)) else None


def _not_near(trials: Trials) -> float | None:
    near = sum(mpd_m < NEAR_M for mpd_m in _known(trials, "mpd_final_m"))
    return 100.0 * (1.0 - near / len(trials))


def _median_of(key: str) -> Callable[[Trials], float | None]:
    return lambda trials: median(known) if (known := _known(trials, key)) else None


_SUMS: Mapping[str, Callable[[Trials], float | None]] = {
    "wrong, %": _share_without("right"),
    "not trusted, %": _share_without("trusted"),
    f"final MPD ≥ {100 * NEAR_M:g} cm, %": _not_near,
    "median final MPD, m": _median_of("mpd_final_m"),
    "median time, s": _median_of("seconds"),
}


def _printed_sums(sensor: str) -> dict[str, float | None]:
    """Return the same of the printed scenes, if the paper has such a sensor."""
    trials = [
        {
            **dict(zip(_KEYS, figures, strict=True)),
            "right": not scene.startswith(FAILED_SCENE),
            "trusted": None,
        }
        for scene, figures in published()["hough_ndt"]["rows"].items()
        if scene.endswith(_PRINTED_AS.get(sensor, "no such sensor"))
    ]
    return {column: summed(trials) for column, summed in _SUMS.items()} if trials else {}


def _as_printed() -> PaperTable:
    cells = [
        PaperCell(scene, column, figure, ())
        for scene, figures in published()["hough_ndt"]["rows"].items()
        for column, figure in zip(_COLUMNS, figures, strict=True)
    ]
    return _table("Table 1", "as printed", cells)


def _in_layout(trials: Trials, method: str) -> PaperTable:
    cells = [
        _cell(f"{pair}, {sensor}", column, of_pair, key)
        for (pair, sensor, of_method), of_pair in _grouped(trials, "pair", "sensor", "method").items()
        if of_method == method
        for key, column in zip(_KEYS, _COLUMNS, strict=True)
    ]
    return _table(f"Table 1, {method}", "our scenes in the paper's layout", cells)


def _against_truth(trials: Trials) -> PaperTable:
    """Return the answers' errors, where the truth is known; answers that are not trusted are listed."""
    cells = []
    for group, of_pair in _grouped(trials, "pair", "sensor", "method").items():
        if not _known(of_pair, "right"):
            continue
        row = ", ".join(map(str, group))
        cells += [_cell(row, column, of_pair, key) for key, column in _ERRORS.items()]
        untrusted = tuple(f"seed {t['seed']}: not trusted: {t['reason']}" for t in of_pair if t["reason"])
        for column, reasons in (("wrong, %", ()), ("not trusted, %", untrusted)):
            share = _SUMS[column](of_pair)
            cells.append(PaperCell(row, column, None, () if share is None else (share,), reasons))
    return _table("Table 1, errors", "our answers against the truth", cells)


def _cell(row: str, column: str, trials: Trials, key: str) -> PaperCell:
    missing = [f"seed {trial['seed']}: {trial['reason']}" for trial in trials if trial[key] is None]
    return PaperCell(row, column, None, tuple(_known(trials, key)), tuple(missing))


def _table(name: str, title: str, cells: Sequence[PaperCell], notes: Sequence[str] = ()) -> PaperTable:
    source = published()["hough_ndt"]["source"]
    return PaperTable(name, title, source, "", "", tuple(cells), notes=tuple(notes))


def _grouped(trials: Trials, *keys: str) -> dict[tuple[Value, ...], list[Record]]:
    groups: dict[tuple[Value, ...], list[Record]] = {}
    for trial in trials:
        groups.setdefault(tuple(trial[key] for key in keys), []).append(trial)
    return groups


def _known(trials: Trials, key: str) -> list[float]:
    return [float(value) for trial in trials if isinstance(value := trial[key], int | float)]
