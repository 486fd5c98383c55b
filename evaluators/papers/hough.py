"""Registration of scans to maps without a guess: the trials of Nagy, Gálai & Benedek (2016), other scenes."""

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.geometry import Transform, angle_between, inverse
from mapper.core.rotations import euler_from_rotation
from mapper.evaluators.papers.hough_pairs import Clouds, Pair, find_pairs
from mapper.evaluators.papers.layout import file_name
from mapper.evaluators.papers.scan_pairs import perturbed
from mapper.evaluators.pictures.registration import write_before_and_after
from mapper.evaluators.register.registration import distance_to, register
from mapper.evaluators.study.versions import digest, versions
from mapper.evaluators.tables.table import Record, Value
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig
from mapper.runtime.resumable_jobs import Job

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
            source, _ = perturbed(clouds.source, np.eye(4), np.eye(4), rng, offset_m=0.0)
            return Clouds(clouds.target, source, None)
        source, T_target_source = perturbed(
            clouds.source, clouds.T_target_source, np.eye(4), rng, offset_m=OFFSET_M
        )
        return Clouds(clouds.target, source, T_target_source)

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
            miss = inverse(truth) @ final
            error_m = float(np.linalg.norm(miss[:3, 3]))
            error_deg = float(np.degrees(angle_between(miss[:3, :3], np.eye(3))))
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
