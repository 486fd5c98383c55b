"""Damaged JPEGs that are accepted as undamaged, how wrong their pixels are, and the time of the check.

    python benchmarks/damaged_jpegs.py [--log LOG/rgb] [--cases 240] [--seeds 3]

Only the entropy-coded data is damaged: 1 to 20 bytes are changed, or 1 to 200 bytes are cut out. Images are
those of a synthetic log and of a folder, encoded again in several ways. "before" counts those that
libjpeg-turbo decodes without a warning, "after" those of them that also pass the check of their codes. A
pixel is wrong if one of its channels is off by more than 30; of the accepted files the table counts those
with more than 1 % of wrong pixels, and gives the median share.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from mapper.core.errors import DataError
from mapper.core.frames import Image
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator
from mapper.sources.image_files.jpeg_entropy import check_entropy
from mapper.sources.image_files.reading import read_colour

_IMAGES = 12
_ENCODINGS = {
    "quality 90": (cv2.IMWRITE_JPEG_QUALITY, 90),
    "quality 75": (cv2.IMWRITE_JPEG_QUALITY, 75),
    "quality 95, 4:4:4": (
        *(cv2.IMWRITE_JPEG_QUALITY, 95),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    ),
    "quality 90, optimised": (cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    "quality 90, a restart marker a row": (cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_RST_INTERVAL, 40),
}
_WRONG = 30
_MUCH_PERCENT = 1.0


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Change 1 … 20 bytes of the scan, or cut 1 … 200 out."""
    begin = data.index(b"\xff\xda") + 14
    end = len(data) - 2
    if rng.random() < 0.5:
        changed = bytearray(data)
        for _ in range(int(rng.integers(1, 21))):
            changed[rng.integers(begin, end)] = int(rng.integers(256))
        return bytes(changed)
    length = int(rng.integers(1, 201))
    at = int(rng.integers(begin, end - length))
    return data[:at] + data[at + length :]


def images_of_a_synthetic_log() -> list[Image]:
    """Return images of a walk through a flat."""
    simulator = CameraSimulator(SynthConfig(seed=5, duration_s=12.0, frame_rate_hz=1.0))
    return [simulator.observe(int(index)).rgb for index in simulator.kept[:_IMAGES]]


def images_of_a_folder(folder: Path) -> list[Image]:
    """Return as many images of a folder, evenly apart."""
    paths = sorted(folder.iterdir())
    return [read_colour(paths[i]) for i in np.linspace(0, len(paths) - 1, _IMAGES).astype(int)]


def encoded(images: list[Image], options: tuple[int, ...]) -> list[bytes]:
    """Return the images as JPEGs."""
    return [cv2.imencode(".jpg", image[:, :, ::-1], list(options))[1].tobytes() for image in images]


def decoded(data: bytes) -> Image | None:
    """Return the pixels, or None if the decoder warns."""
    try:
        pixels: Image = simplejpeg.decode_jpeg(data, "RGB")
    except ValueError:
        return None
    return pixels


def is_taken(data: bytes) -> bool:
    """Tell whether the check finds nothing wrong."""
    try:
        check_entropy(data)
    except DataError:
        return False
    return True


def cases(files: list[bytes], count: int, seed: int) -> Iterator[tuple[bytes, bytes]]:
    """Yield (whole, damaged) files; every one differs."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        whole = files[i % len(files)]
        changed = damaged(whole, rng)
        if changed != whole:
            yield whole, changed


def measure(name: str, files: list[bytes], count: int, seeds: int) -> None:
    """Print a row of the table."""
    before, after, total = list[float](), list[float](), 0
    for seed in range(seeds):
        for whole, changed in cases(files, count, seed):
            total += 1
            pixels = decoded(changed)
            if pixels is None:
                continue
            true = decoded(whole)
            assert true is not None
            if pixels.shape != true.shape:
                wrong = 1.0
            else:
                wrong = float((np.abs(pixels.astype(int) - true).max(axis=2) > _WRONG).mean())
            before.append(wrong)
            if is_taken(changed):
                after.append(wrong)
    whole_ms = _milliseconds(check_entropy, files)
    print(f"| {name} | {total} | {_shares(before)} | {_shares(after)} | {whole_ms:.2f} |", flush=True)


def _shares(wrong: list[float]) -> str:
    shares = 100.0 * np.array(wrong)
    median = f"{np.median(shares):.2f} %" if wrong else "–"
    return f"{len(wrong)} | {np.sum(shares > _MUCH_PERCENT)} | {median}"


def _milliseconds(check, files: list[bytes]) -> float:  # type: ignore[no-untyped-def]
    best = np.inf
    for _ in range(5):
        begin = time.process_time()
        for data in files:
            check(data)
        best = min(best, time.process_time() - begin)
    return 1e3 * best / len(files)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--log", type=Path, help="folder of images to encode again")
    parser.add_argument("--cases", type=int, default=240)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    sources = {"synthetic": images_of_a_synthetic_log()}
    if options.log is not None:
        sources[options.log.parent.name] = images_of_a_folder(options.log)
    print("| images | damaged | before | > 1 % wrong | median | after | > 1 % wrong | median | check, ms |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for source, images in sources.items():
        for name, encoding in _ENCODINGS.items():
            files = encoded(images, encoding)
            assert all(is_taken(data) for data in files)
            measure(f"{source}, {name}", files, options.cases, options.seeds)


if __name__ == "__main__":
    main()
