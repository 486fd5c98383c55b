"""Images and scans that fusing hands on for a run's MCAP log."""

import numpy as np

from mapper.config.build import BuildConfig
from mapper.config.loading import overridden
from mapper.core.frames import Scan
from mapper.core.trajectory import Trajectory
from mapper.mapping.config import Edits
from mapper.mapping.map_building import build_maps
from mapper.octree.scan_updates import ScanUpdateWriter
from mapper.runtime.progress import SILENT
from mapper.simulation import CameraSimulator
from mapper.simulation.config import SynthConfig
from tests.support.logs import log_in_memory, memory_entry


def snapshots(log, trajectory, tmp_path, *settings):
    """Return those of every frame."""
    config = overridden(BuildConfig(), ["workers=0", "mcap.image_stride=1", "octree.moving=kept", *settings])
    seen = []
    with ScanUpdateWriter(tmp_path / "updates.bin", config.octree) as updates:
        build_maps(
            log,
            trajectory,
            config,
            progress=SILENT,
            on_snapshot=seen.append,
            cached=None,
            updates=updates,
            edits=Edits(),
        )
    return seen


def test_images_have_the_width_that_is_set(tmp_path):
    log = CameraSimulator(
        SynthConfig(width_px=160, height_px=120, texture_px_per_m=32, frame_rate_hz=2.0, duration_s=1.0)
    ).log()
    wide, narrow = (
        snapshots(log, log.truth, tmp_path, f"mcap.image_width_px={width}") for width in (320, 40)
    )
    assert len(wide) == len(narrow) == len(log)
    assert (wide[0].camera.width_px, narrow[0].camera.width_px) == (160, 40)


def test_scans_are_thinned_to_a_point_per_voxel(tmp_path):
    x, y = np.meshgrid(np.arange(-4.0, 4.0, 0.1), np.arange(-4.0, 4.0, 0.1))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.55)], axis=1).astype(np.float32)
    log = log_in_memory([memory_entry(k, Scan(k, points, np.zeros(3))) for k in range(2)], sensor="lidar")
    still = Trajectory(log.stamps_ns, np.tile(np.eye(4), (2, 1, 1)))
    seen = snapshots(log, still, tmp_path, "slice.min_height_m=-2")
    assert len(seen) == 2
    assert 26**2 <= len(seen[0].points_body) <= 28**2
