"""Table 1 of Nagy, Gálai & Benedek (2016): registration of scans to maps without a guess, on other scenes."""

import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median

import numpy as np

from mapper.core.geometry import Transform, inverse, length_and_angle
from mapper.core.rotations import euler_from_rotation
from mapper.evaluators.compare.registration import distance_to, register
from mapper.evaluators.papers.hough_pairs import (
    ALL_RINGS,
    EXTRINSIC_DEG,
    EXTRINSIC_M,
    FEW_RINGS,
    MAP_VOXEL_M,
    RIGHT_DEG,
    RIGHT_M,
    Clouds,
    Pair,
    find_pairs,
    perturbed,
)
from mapper.evaluators.papers.model import PaperCell, PaperTable, Reproduction, file_name
from mapper.evaluators.papers.paper import published
from mapper.evaluators.pictures.registration import write_before_and_after
from mapper.evaluators.study.engine import digest, versions
from mapper.evaluators.study.table import Record, Value
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig
from mapper.runtime.resumable_jobs import Job, JobResult

OFFSET_M = 10.0
METHODS: dict[str, HoughNdtConfig | HoughGicpConfig] = {
    "hough-ndt": HoughNdtConfig(),
    "hough-gicp": HoughGicpConfig(),
}
_STAGES = {"before": "input", "Hough": "hough", "refined": "final"}
DISTANCES = tuple(f"{kind}_{stage}_m" for kind in ("mhd", "mpd") for stage in _STAGES.values())


@dataclass(frozen=True, slots=True)
class HoughTrial:
    """One registration of one pair by one method, from a random yaw and offset.

    Attributes:
        pair: The scan and the map.
        method: One of ``METHODS``.
        seed: Seed of the yaw, which is any, and of the offset, up to 10 m. A pair without a known truth is
            only turned.
        picture: PNG file to draw; None draws none.
    """

    pair: Pair
    method: str
    seed: int
    picture: Path | None

    def __call__(self) -> list[Record]:
        """Return the trial's row of Table 1, and how far its answer is from the truth; None is not known.

        Raises:
            MapperError: A cloud cannot be read, or is empty.
        """
        clouds = self._perturbed(self.pair.clouds())
        registered = register(clouds.target, clouds.source, METHODS[self.method], np.eye(4))
        stages = {_STAGES[stage.name]: stage for stage in registered.stages}
        if self.picture is not None:
            write_before_and_after(
                self.picture,
                clouds.target.points_body,
                clouds.source.points_body,
                [(name, stage.T_target_source) for name, stage in stages.items()],
                sensor="lidar",
                title=f"{self.pair.name}, {self.pair.sensor} (red) in its map (blue): {self.method}",
            )
        is_trusted = registered.alignment.converged
        record: dict[str, Value] = {
            "pair": self.pair.name,
            "sensor": self.pair.sensor,
            "method": self.method,
            "seed": self.seed,
            **dict.fromkeys(("offset_m", "yaw_deg", *DISTANCES)),
            "seconds": registered.cpu_s,
            **dict.fromkeys(("error_m", "error_deg", "mpd_truth_m", "right")),
            "trusted": int(is_trusted),
            "reason": registered.alignment.reason,
        }
        for name, stage in stages.items():
            record |= {f"mhd_{name}_m": stage.distance.mhd_m, f"mpd_{name}_m": stage.distance.mpd_m}
        final = stages["final"].T_target_source if "final" in stages else None
        return [record | self._against_truth(clouds, final, is_trusted=is_trusted)]

    def _perturbed(self, clouds: Clouds) -> Clouds:
        # By the pair and the seed alone, so that both methods get the same.
        rng = np.random.default_rng([self.seed, zlib.crc32(f"{self.pair.name} {self.pair.sensor}".encode())])
        if clouds.T_target_source is None:
            return Clouds(clouds.target, perturbed(clouds.source, np.eye(4), rng, offset_m=0.0)[0], None)
        return Clouds(
            clouds.target, *perturbed(clouds.source, clouds.T_target_source, rng, offset_m=OFFSET_M)
        )

    def _against_truth(
        self, clouds: Clouds, final: Transform | None, *, is_trusted: bool
    ) -> dict[str, Value]:
        """Return where the scan was, by the truth or else by a trusted answer, and the answer's errors."""
        truth = clouds.T_target_source
        values: dict[str, Value] = {}
        known = final if truth is None and is_trusted else truth
        if known is not None:
            values["offset_m"] = float(np.linalg.norm(known[:3, 3]))
            values["yaw_deg"] = abs(float(np.degrees(euler_from_rotation(known[:3, :3])[2])))
        if truth is None:
            return values
        distance = distance_to(clouds.target).of(clouds.source.points_body, truth)
        values |= {"mpd_truth_m": distance.mpd_m, "right": 0}
        if final is not None:
            error_m, error_rad = length_and_angle(inverse(truth) @ final)
            error_deg = float(np.degrees(error_rad))
            within_m, within_deg = self.pair.within
            is_right = error_m < within_m and error_deg < within_deg
            values |= {"error_m": error_m, "error_deg": error_deg, "right": int(is_right)}
        return values


def hough_jobs(logs: Path, *, seeds: int, pictures: Path) -> dict[HoughTrial, Job]:
    """Return the trials of a folder's pairs, by both methods and every seed; those of seed 0 draw a picture.

    Args:
        logs: Folder of logs, as of :func:`~mapper.evaluators.papers.hough_pairs.find_pairs`.
        seeds: Number of perturbations of each pair.
        pictures: Folder for the pictures.

    Raises:
        ConfigError: ``pairs.toml`` cannot be read.
        SourceError: There are no pairs.
    """
    jobs = {}
    for pair in find_pairs(logs.resolve()):
        identity = pair.identity()
        for method in METHODS:
            for seed in range(seeds):
                name = f"{pair.name}, {pair.sensor}, {method}"
                picture = picture_of(pictures.resolve(), name) if seed == 0 else None
                trial = HoughTrial(pair, method, seed, picture)
                jobs[trial] = Job(_key(trial, identity), f"{name}, seed {seed}", trial)
    return jobs


def picture_of(pictures: Path, name: str) -> Path:
    """Return the file that shows a pair and a method, called by pair, sensor and method."""
    return pictures / f"{file_name(name)}.png"


def _key(trial: HoughTrial, identity: str) -> str:
    names = f"{trial.pair.name} {trial.pair.sensor} {trial.seed}"
    decides = digest(versions(), identity, names, METHODS[trial.method].model_dump_json(), digits=12)
    return f"{trial.method}.seed{trial.seed}.{decides}"


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
    medians = [median(known) for pair in pairs if (known := _known(pair, key))]
    return f"{sum(distance_m < NEAR_M for distance_m in medians)} of {len(medians)}"


def _share_without(key: str) -> Callable[[Trials], float | None]:
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
