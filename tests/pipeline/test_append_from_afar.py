"""A session that sees a place from much farther than the one before."""

import numpy as np
import pytest

from mapper.core.geometry import inverse
from mapper.run.folder import open_run
from mapper.sources.writers import write_log
from tests.support.command_line import mapper
from tests.support.logs import log_in_memory, memory_entry
from tests.support.stepped_wall import facing, painting, wall_image

INTERVAL_NS = 100_000_000
NEAR = [facing(0.1 + 0.03 * k, 0.0, -1.6 - 0.01 * k) for k in range(12)]
FAR = [facing(-0.3, 0.3 - 0.03 * k, -5.5 + 0.01 * k, yaw=0.1) for k in range(12)]


def walk(folder, poses, seed):
    painted = painting(seed)
    images = [wall_image(painted, pose, INTERVAL_NS * k) for k, pose in enumerate(poses)]
    log = log_in_memory([memory_entry(image.stamp_ns, image) for image in images])
    assert not write_log(log, folder, kind="tum")
    return folder


@pytest.fixture(scope="module")
def near(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walls")
    mapper("build", walk(folder / "near", NEAR, 1), "--out", folder / "run", "--quiet")
    return folder / "run"


def test_a_session_from_afar_is_connected_by_images_from_near_and_far(near, tmp_path):
    mapper("build", walk(tmp_path / "far", FAR, 1), "--onto", near, "--out", tmp_path / "both", "--quiet")
    both = open_run(tmp_path / "both")
    T_first, T_last = both.trajectory.T_world_body[[0, -1]]
    T_first_last = inverse(NEAR[0]) @ FAR[-1]
    assert np.linalg.norm((inverse(T_first) @ T_last)[:3, 3] - T_first_last[:3, 3]) < 0.1


def test_another_wall_from_afar_is_refused(near, tmp_path):
    result = mapper(
        "build", walk(tmp_path / "far", FAR, 2), "--onto", near, "--out", tmp_path / "both", status=1
    )
    assert "no loop connects it" in result.stderr
