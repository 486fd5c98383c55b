"""LAS and LAZ: the ASPRS's exchange format of surveys."""

from pathlib import Path

from mapper.errors import FrameError
from mapper.sources.cloud_files.raw import Columns

_EXTRAS = ("gps_time", "red", "green", "blue")


def read_las(path: Path) -> Columns:
    """Read coordinates with the file's scale and offset applied, in float64, and times and colours if any.

    Raises:
        FrameError: It is malformed or cut.
    """
    import laspy

    with path.open("rb") as stream:
        try:
            cloud = laspy.read(stream, closefd=False)
        except Exception as error:  # damaged bytes raise whatever the line that met them raises
            raise FrameError(f"{path}: not a sound LAS file: {error}") from None
    present = set(cloud.point_format.dimension_names)
    columns = {"x": cloud.x, "y": cloud.y, "z": cloud.z}
    return {**columns, **{name: cloud[name] for name in _EXTRAS if name in present}}
