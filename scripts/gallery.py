"""Map recorded and synthetic logs, and write the gallery: docs/gallery.md and its pictures in docs/gallery/.

    python scripts/gallery.py --logs DIR [--work DIR] [--only NAME …]

DIR has the recorded logs tum_fr1_xyz, kitti_00 and mulran_kaist03; synthetic logs are made. Existing runs in
the work folder are used as they are. Pictures are shrunk to a page's width.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parent.parent
MAPPER = [sys.executable, "-c", "from mapper.cli.main import main; main()"]
PAGE, OUT = ROOT / "docs" / "gallery.md", ROOT / "docs" / "gallery"
WIDTH_PX = 1000
QUALITY = 78
MOST_BYTES = 3_000_000


@dataclass(frozen=True, slots=True)
class Entry:
    """A run of the gallery.

    Attributes:
        name: Name of the run, and of its pictures.
        title: Heading of the page's section.
        about: What is to be seen.
        commands: Lines that make it, each a command of mapper.
        pictures: Files of the run and their captions.
        log: Folder of the recorded log in DIR, and its name in the commands; None for a synthetic one.
    """

    name: str
    title: str
    about: str
    commands: tuple[str, ...]
    pictures: dict[str, str]
    log: tuple[str, str] | None = None


ENTRIES = (
    Entry(
        "xyz",
        "A desk, hand-held",
        "TUM fr1/xyz: 26 s from a Kinect moved back and forth in front of a desk.",
        ("build rgbd_dataset_freiburg1_xyz --out runs/xyz",),
        {"cloud.png": "the coloured cloud", "summary.png": "the path over the slice, with its truth"},
        ("tum_fr1_xyz", "rgbd_dataset_freiburg1_xyz"),
    ),
    Entry(
        "kitti",
        "A street, 16 sweeps",
        "KITTI odometry 00, scans 0 to 15: 12 m of a Velodyne HDL-64 on a car.",
        ("build kitti_00 --out runs/kitti",),
        {"cloud.png": "the cloud", "slice.png": "the slice; white is free, grey unknown"},
        ("kitti_00", "kitti_00"),
    ),
    Entry(
        "kaist",
        "A campus road",
        "MulRan KAIST03: 21 keyframes of an Ouster OS1-64 over 24 m.",
        ("build mulran_kaist03 --out runs/kaist",),
        {"cloud.png": "the cloud", "traversable.png": "the floor that a robot can reach"},
        ("mulran_kaist03", "mulran_kaist03"),
    ),
    Entry(
        "flat",
        "A flat",
        "A synthetic walk through a flat with a Kinect's noise and exact truth.",
        (
            "synth logs/flat --seed 3",
            "build logs/flat --out runs/flat",
        ),
        {
            "cloud.png": "the coloured cloud",
            "slice.png": "the slice: what stands 0.1 to 1.2 m above the floor",
            "traversable.png": "the floor that a robot can reach",
        },
    ),
    Entry(
        "block",
        "Round a block of streets",
        "A synthetic LiDAR drive, scanned in motion, with cars, cyclists and pedestrians, all in no map.",
        (
            "synth logs/block --sensor lidar --moving --rings 32 --seed 2 --seconds 20",
            "build logs/block --out runs/block",
        ),
        {"cloud.png": "the cloud", "summary.png": "the path over the slice, with its truth"},
    ),
    Entry(
        "stairs",
        "Storeys",
        "A synthetic LiDAR carried up a staircase: one traversable floor per storey.",
        (
            "synth logs/stairs --sensor lidar --scene staircase --rings 32",
            "build logs/stairs --out runs/stairs --config configs/lidar_indoor.toml",
        ),
        {
            "cloud.png": "the cloud, from above and from the side",
            "traversable.png": "the storey on which the log begins",
        },
    ),
)


def make(entry: Entry, logs: Path, work: Path) -> list[str]:
    """Build an entry's run unless it is there, write its pictures, and return its lines of the page."""
    if entry.log is not None:
        link = work / entry.log[1]
        if not link.exists():
            link.symlink_to((logs / entry.log[0]).resolve())
    run = work / "runs" / entry.name
    if not run.exists():
        for command in entry.commands:
            target = work / shlex.split(command)[1]
            if command.startswith("synth") and target.exists():
                continue
            print(f"mapper {command}", flush=True)
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            subprocess.run([*MAPPER, *shlex.split(command), "--quiet"], cwd=work, env=environment, check=True)
    manifest = json.loads((run / "manifest.json").read_text(encoding="utf-8"))
    counts = manifest["counts"]
    verdict = ": ".join([manifest["verdict"]["state"], *manifest["verdict"]["sentences"][:1]])
    lines = [f"## {entry.title}", "", entry.about, "", "```sh"]
    lines += [f"mapper {command}" for command in entry.commands]
    lines += ["```", ""]
    lines.append(
        f"{counts['tracked']} frames tracked, {counts['loops']} loops, {counts['leaves']} octree leaves, "
        f"{counts['cloud_points']} points in the cloud; {verdict}."
    )
    for name, caption in entry.pictures.items():
        picture = write_picture(run / name, entry.name)
        lines += ["", f"![{entry.title}: {caption}](gallery/{picture.name})"]
    return [*lines, ""]


def section_of(entry: Entry, page: str) -> list[str]:
    """Return the lines that a page has about a run; none if it has none."""
    _, title, rest = page.partition(f"## {entry.title}\n")
    return [*(title + rest.partition("\n## ")[0]).rstrip().splitlines(), ""] if title else []


def write_picture(source: Path, name: str) -> Path:
    """Write a picture of a run, no wider than a page, and return its path."""
    image = cv2.imread(str(source), cv2.IMREAD_COLOR)
    height_px, width_px = image.shape[:2]
    scale = min(1.0, WIDTH_PX / width_px, WIDTH_PX / height_px)
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    path = OUT / f"{name}_{source.stem}.jpg"
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return path


def main() -> int:
    """Make the gallery."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=Path, required=True, help="folder with the recorded logs")
    parser.add_argument("--work", type=Path, help="folder to work in; a temporary one by default")
    parser.add_argument(
        "--only",
        action="append",
        choices=[entry.name for entry in ENTRIES],
        help="a run to make; the others stay on the page as they are",
    )
    arguments = parser.parse_args()
    OUT.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = (arguments.work or Path(temporary)).resolve()
        (work / "runs").mkdir(parents=True, exist_ok=True)
        if not (work / "configs").exists():
            (work / "configs").symlink_to(ROOT / "configs")
        lines = [
            "# Gallery",
            "",
            "Made by `python scripts/gallery.py --logs DIR`; the commands below make each run again.",
            "",
        ]
        for entry in ENTRIES:
            if arguments.only is None or entry.name in arguments.only:
                lines += make(entry, arguments.logs, work)
            else:
                lines += section_of(entry, PAGE.read_text(encoding="utf-8"))
    size = sum(path.stat().st_size for path in OUT.iterdir())
    if size > MOST_BYTES:
        print(f"{OUT}: {size} bytes, want {MOST_BYTES} at most: lower QUALITY or WIDTH_PX", file=sys.stderr)
        return 1
    PAGE.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    print(f"docs/gallery.md, {size / 1e6:.2f} MB of pictures")
    return 0


if __name__ == "__main__":
    sys.exit(main())
