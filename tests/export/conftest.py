"""What tests of exports share."""

from pathlib import Path

import pytest

from mapper.config.loading import load_config
from mapper.pipeline.build import build
from mapper.run.folder import Run
from mapper.sources import open_source


@pytest.fixture(scope="session")
def run(desk_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A small run whose octree has times and hits; no test may write into it."""
    settings = ["source.last_frame=12", "octree.resolution_m=0.1", "octree.attributes=true"]
    settings += ["mesh.voxel_m=0.04", "mesh.frame_stride=2", "mesh.min_observations=1"]
    config = load_config(None, settings)
    return build(open_source(desk_log, config.source), config, tmp_path_factory.mktemp("export") / "run")
