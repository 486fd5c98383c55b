"""Maps from recorded RGB-D and LiDAR logs: odometry, pose graph, octree and exports.

Names are loaded when they are first used, so that ``import mapper`` takes no time:

    >>> import mapper
    >>> run = mapper.build("rgbd_dataset_freiburg1_xyz", out="runs/xyz")    # doctest: +SKIP
    >>> run.octree.query(run.trajectory.positions)                          # doctest: +SKIP
    array([0, 0, 0, ..., 0, 0, 0], dtype=int8)
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mapper.api.build import build
    from mapper.api.localise import localise
    from mapper.api.logs import inspect, open_log
    from mapper.api.merging import diff, merge
    from mapper.api.octree import read_octree
    from mapper.api.plan import plan
    from mapper.api.register import register
    from mapper.config.loading import load_config
    from mapper.core.errors import MapperError
    from mapper.evaluators.compare.files import compare
    from mapper.evaluators.metrics.evaluate import evaluate
    from mapper.octree.map import OctreeMap
    from mapper.run.folder import Run, open_run

__version__ = "0.2.0"

__all__ = [
    "MapperError",
    "OctreeMap",
    "Run",
    "build",
    "compare",
    "diff",
    "evaluate",
    "inspect",
    "load_config",
    "localise",
    "merge",
    "open_log",
    "open_run",
    "plan",
    "read_octree",
    "register",
]

_HOMES = {
    "MapperError": "mapper.core.errors",
    "OctreeMap": "mapper.octree.map",
    "Run": "mapper.run.folder",
    "build": "mapper.api.build",
    "compare": "mapper.evaluators.compare.files",
    "diff": "mapper.api.merging",
    "evaluate": "mapper.evaluators.metrics.evaluate",
    "inspect": "mapper.api.logs",
    "load_config": "mapper.config.loading",
    "localise": "mapper.api.localise",
    "merge": "mapper.api.merging",
    "open_log": "mapper.api.logs",
    "open_run": "mapper.run.folder",
    "plan": "mapper.api.plan",
    "read_octree": "mapper.api.octree",
    "register": "mapper.api.register",
}


def __getattr__(name: str) -> Any:
    """Load a name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(  # Python adds which name was perhaps meant
            f"module 'mapper' has no attribute {name!r}", name=name, obj=sys.modules[__name__]
        )
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
