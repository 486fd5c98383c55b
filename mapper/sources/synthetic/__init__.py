"""A furnished flat that does not exist, recorded by a camera that never made a mistake we do not know of."""

from mapper.sources.synthetic.boxes import Boxes, read_scene
from mapper.sources.synthetic.log import write_tum_log
from mapper.sources.synthetic.path import make_path
from mapper.sources.synthetic.raycast import Rendering, render
from mapper.sources.synthetic.scene import Scene, make_scene
from mapper.sources.synthetic.sensor import observe
from mapper.sources.synthetic.source import SyntheticSource, camera_of

__all__ = [
    "Boxes",
    "Rendering",
    "Scene",
    "SyntheticSource",
    "camera_of",
    "make_path",
    "make_scene",
    "observe",
    "read_scene",
    "render",
    "write_tum_log",
]
