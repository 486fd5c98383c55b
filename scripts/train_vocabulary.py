"""Train the vocabulary that is included in the toolkit, on synthetic logs only; takes a few minutes.

    python scripts/train_vocabulary.py [--out mapper/places/orb.words]

The same code gives the same bytes.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from mapper.cli.console import progress_for
from mapper.places.config import VocabularyConfig
from mapper.places.training import descriptors_of, train
from mapper.places.vocabulary import SHIPPED
from mapper.simulation import CameraSimulator, make_scene
from mapper.simulation.config import SensorConfig, SynthConfig
from mapper.sources.base import Log

FIRST_SEED = 1000  # far from the seeds that tests and examples use
FLATS = 12


def logs() -> Iterator[Log]:
    """Yield walks through flats of many sizes, emptier and fuller, seen sharply and less so."""
    rng = np.random.default_rng(FIRST_SEED)
    for seed in range(FIRST_SEED, FIRST_SEED + FLATS):
        flat = SynthConfig(
            seed=seed,
            rooms=4,
            room_size_m=round(float(rng.uniform(3.8, 5.2)), 2),
            room_height_m=round(float(rng.uniform(2.4, 3.2)), 2),
            furniture_per_room=int(rng.integers(5, 15)),
            posters_per_room=int(rng.integers(3, 13)),
            sensor=SensorConfig(
                image_noise_levels=round(float(rng.uniform(0.5, 4.0)), 2),
                exposure_s=0.01 * (seed % 3 == 0),
            ),
        )
        scene = make_scene(flat)
        for path, rate_hz in (("loop", 0.6), ("spin", 0.3), ("desk", 0.15)):
            config = flat.model_copy(update={"path": path, "frame_rate_hz": rate_hz})
            yield CameraSimulator(config, scene).log()


def main() -> None:
    """Render, detect, train, save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=SHIPPED)
    out: Path = parser.parse_args().out
    cv2.setNumThreads(1)
    config, progress = VocabularyConfig(), progress_for(quiet=False)
    images = [bits for log in logs() for bits in descriptors_of(log, config, progress=progress)]
    vocabulary = train(
        images,
        config=config,
        trained_on=f"{len(images)} images of {FLATS} synthetic flats, seeds {FIRST_SEED} and up",
        rng=np.random.default_rng(FIRST_SEED),
        progress=progress,
    )
    vocabulary.save(out)


if __name__ == "__main__":
    main()
