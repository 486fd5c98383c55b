"""Registration of scans to maps without a guess: the trials of Nagy, Gálai & Benedek (2016), other scenes."""

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from evaluators.metrics.cloud_distance import DistanceTo
from evaluators.papers.hough_pairs import Clouds, Pair, find_pairs
from evaluators.papers.layout import file_name
from evaluators.papers.scan_pairs import perturbed
from evaluators.pictures.registration import write_before_and_after
from evaluators.register.registration import thinned
from evaluators.study.versions import digest, versions
from evaluators.tables.table import Record, Value
from mapper.core.frames import Scan
from mapper.core.geometry import Transform, angle_between, inverse
from mapper.core.rotations import euler_from_rotation
from mapper.registration.hough.aligner import Hough, Stages
from mapper.registration.hough.config import HoughConfig, HoughGicpConfig, HoughNdtConfig
from mapper.runtime.job_runner import Job

OFFSET_M = 10.0
METHODS: dict[str, HoughConfig] = {"hough-ndt": HoughNdtConfig(), "hough-gicp": HoughGicpConfig()}
DISTANCES = tuple(f"{kind}_{stage}_m" for kind in ("mhd", "mpd") for stage in ("input", "hough", "final"))


@dataclass(frozen=True, slots=True)
class HoughTrial:
    """One registration of one pair by one method, from a random yaw and offset.

    Attributes:
        pair: The scan and the map.
        method: One of ``METHODS``.
        seed: Of the yaw, which is any, and of the offset, up to 10 m. A pair without a known truth is only
            turned.
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
        stages, seconds = _timed(clouds, METHODS[self.method])
        motions = _motions(stages)
        if self.picture is not None:
            write_before_and_after(
                self.picture,
                clouds.target.points_body,
                clouds.source.points_body,
                list(motions.items()),
                sensor="lidar",
                title=f"{self.pair.name}, {self.pair.sensor} (red) in its map (blue): {self.method}",
            )
        record: dict[str, Value] = {
            "pair": self.pair.name,
            "sensor": self.pair.sensor,
            "method": self.method,
            "seed": self.seed,
            **dict.fromkeys(("offset_m", "yaw_deg", *DISTANCES)),
            "seconds": seconds,
            **dict.fromkeys(("error_m", "error_deg", "mpd_truth_m", "right")),
            "trusted": int(stages.alignment.converged),
            "reason": stages.alignment.reason,
        }
        for stage, T_target_source in motions.items():
            distance = _distance_to(clouds.target).of(clouds.source.points_body, T_target_source)
            record[f"mhd_{stage}_m"], record[f"mpd_{stage}_m"] = distance.mhd_m, distance.mpd_m
        return [record | self._against_truth(clouds, motions, is_trusted=stages.alignment.converged)]

    def _perturbed(self, clouds: Clouds) -> Clouds:
        # Whichever the method, a pair is perturbed alike.
        rng = np.random.default_rng([self.seed, zlib.crc32(f"{self.pair.name} {self.pair.sensor}".encode())])
        if clouds.T_target_source is None:
            source, _ = perturbed(clouds.source, np.eye(4), np.eye(4), rng, offset_m=0.0)
            return Clouds(clouds.target, source, None)
        source, T_target_source = perturbed(
            clouds.source, clouds.T_target_source, np.eye(4), rng, offset_m=OFFSET_M
        )
        return Clouds(clouds.target, source, T_target_source)

    def _against_truth(
        self, clouds: Clouds, motions: Mapping[str, Transform], *, is_trusted: bool
    ) -> dict[str, Value]:
        """Return where the scan was, by the truth or else by a trusted answer, and how far that is off."""
        final, truth = motions.get("final"), clouds.T_target_source
        values: dict[str, Value] = {}
        known = final if truth is None and is_trusted else truth
        if known is not None:
            values["offset_m"] = float(np.linalg.norm(known[:3, 3]))
            values["yaw_deg"] = abs(float(np.degrees(euler_from_rotation(known[:3, :3])[2])))
        if truth is None:
            return values
        distance = _distance_to(clouds.target).of(clouds.source.points_body, truth)
        values |= {"mpd_truth_m": distance.mpd_m, "right": 0}
        if final is not None:
            miss = inverse(truth) @ final
            error_m = float(np.linalg.norm(miss[:3, 3]))
            error_deg = float(np.degrees(angle_between(miss[:3, :3], np.eye(3))))
            within_m, within_deg = self.pair.within
            is_right = error_m < within_m and error_deg < within_deg
            values |= {"error_m": error_m, "error_deg": error_deg, "right": int(is_right)}
        return values


def _timed(clouds: Clouds, config: HoughConfig) -> tuple[Stages, float]:
    """Return the registration step by step, and its CPU time: a wall clock sees other programs, too."""
    Hough(config).prepare(thinned(clouds.target)).stages(thinned(clouds.source))
    began = time.process_time()
    stages = Hough(config).prepare(clouds.target).stages(clouds.source)
    return stages, time.process_time() - began


def _motions(stages: Stages) -> dict[str, Transform]:
    """Return the motion at each of the paper's stages, as far as it came."""
    motions: dict[str, Transform] = {"input": np.eye(4)}
    if stages.hough is not None:
        motions["hough"] = stages.hough.T_target_source
    if stages.alignment.converged or stages.alignment.information is not None:
        motions["final"] = stages.alignment.T_target_source
    return motions


@lru_cache(maxsize=1)
def _distance_to(target: Scan) -> DistanceTo:
    return DistanceTo(target.points_body)


def hough_jobs(logs: Path, *, seeds: int, pictures: Path) -> dict[HoughTrial, Job]:
    """Return the trials of a folder's pairs, by both methods and every seed; those of seed 0 draw a picture.

    Args:
        logs: As for :func:`~evaluators.papers.hough_pairs.find_pairs`.
        seeds: How often each pair is perturbed.
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
