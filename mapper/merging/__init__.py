"""Many runs' octrees as one map, tile by tile, so that it need not fit into one machine's memory."""

from pathlib import Path
from typing import TYPE_CHECKING

from mapper.run.folder import Run, open_run
from mapper.run.manifest import is_merged_map

if TYPE_CHECKING:
    from mapper.merging.merged_map import MergedMap


def open_map_folder(path: Path) -> "Run | MergedMap":
    """Return a finished run or a finished merged map.

    Raises:
        RunError: The folder is missing, is neither, or is not finished.
    """
    if not is_merged_map(path):
        return open_run(path)
    from mapper.merging.merged_map import open_map  # compiled code, which runs do not need

    return open_map(path)
