import sys
import tomllib
from importlib import metadata

import numpy as np
import pytest

from mapper import __version__
from mapper.core.errors import DependencyError
from mapper.odometry.scans.config import KissOdometryConfig
from mapper.registration.config import KissMatcherConfig, NdtConfig
from mapper.runtime.extras import DISTRIBUTION, extra, require
from tests.support.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_distribution_has_the_name_that_messages_give():
    assert PROJECT["name"] == DISTRIBUTION
    assert f"version: {__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_all_is_every_extra_and_dev_has_all():
    extras = PROJECT["optional-dependencies"]
    (every,) = extras["all"]
    assert every == f"{DISTRIBUTION}[{','.join(sorted(extras.keys() - {'all', 'dev'}))}]"
    assert f"{DISTRIBUTION}[all]" in extras["dev"]


def test_no_extra_is_needed_twice():
    core = {line.partition(">")[0] for line in PROJECT["dependencies"]}
    for name, lines in PROJECT["optional-dependencies"].items():
        assert not core & {line.partition(">")[0] for line in lines}, name


def test_a_library_that_is_there_is_loaded_and_other_errors_of_an_import_stay():
    require("json", "viewer", "a test")
    with extra("viewer", "a test"):
        import json
    assert json.loads("1") == 1
    with pytest.raises(ImportError, match="libGL"), extra("viewer", "a test"):
        raise ImportError("libGL.so.1: cannot open shared object file")


def view():
    import mapper.export.rerun.target  # noqa: F401


def kiss_icp():
    from mapper.odometry.scans.kiss_icp_matcher import KissMatcher

    KissMatcher(KissOdometryConfig())


def kiss_matcher():
    from mapper.registration import kiss_matcher as module

    module._library.cache_clear()
    scan = _scan()
    module.KissMatcher(scan, KissMatcherConfig()).align(scan, np.eye(4))


def ndt():
    from mapper.registration.ndt import Ndt

    Ndt(_scan(), NdtConfig()).align(_scan(), np.eye(4))


def sweep():
    from pathlib import Path

    from mapper.evaluators.sweep.plan import plan_sweep

    plan_sweep(Path("sweep.toml"), Path("out"))


def _scan():
    from mapper.core.frames import Scan

    points = np.random.default_rng(0).uniform(-5.0, 5.0, (500, 3)).astype(np.float32)
    return Scan(points_body=points, origin_body=np.zeros(3), stamp_ns=0)


@pytest.mark.parametrize(
    ("use", "library", "name"),
    [
        (view, "rerun", "viewer"),
        (kiss_icp, "kiss_icp", "peers"),
        (kiss_matcher, "kiss_matcher", "peers"),
        (ndt, "open3d", "peers"),
        (sweep, "pyarrow", "study"),
    ],
)
def test_the_use_of_an_absent_library_names_its_extra(monkeypatch, use, library, name):
    for module in list(sys.modules):
        if module.split(".")[0] == library or module.startswith("mapper.export.rerun"):
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(DependencyError) as raised:
        use()
    assert f"needs {library}" in str(raised.value)
    assert str(raised.value).endswith(f"which is not installed: pip install '{DISTRIBUTION}[{name}]'")
    lines = PROJECT["optional-dependencies"][name]
    (distribution,) = metadata.packages_distributions()[library]
    assert any(line.startswith(distribution.replace("_", "-")) for line in lines)
