"""ROS 2's nav2: the inflated slice as files that map_server loads, and a folder from which nav2 starts."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.export.crs import place_of
from mapper.export.export_folders import export_folder
from mapper.export.figures import CELL_PX, FREE_CELL, OCCUPIED_CELL, UNKNOWN_CELL
from mapper.export.grid import write_grid, write_values
from mapper.navigation.config import CostmapConfig
from mapper.navigation.distance import plane_distances
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, overlap_of, with_obstacles
from mapper.run.georeference_record import Georeference
from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import write_bytes, write_text
from mapper.runtime.progress import Progress

NO_INFORMATION, LETHAL, INSCRIBED, FREE_SPACE = 255, 254, 253, 0
"""nav2_costmap_2d's cost values."""

_INSCRIBED = OCCUPIED - 1


def costmap(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write YAML in map_server's mode "raw" with PGM and PNG beside it.

    Raises:
        DataError: The configured radii do not fit together.
    """
    config = run.config.costmap
    grid = with_obstacles(run.slice, run.keepout)
    costs = inflate(
        grid,
        robot_radius_m=config.robot_radius_m,
        inflation_radius_m=config.inflation_radius_m,
        cost_scaling=config.cost_scaling,
    )
    values = occupancy_values(costs)
    write_bytes(path.with_suffix(".png"), _picture(values))
    write_values(path.parent, path.stem, values, grid)


def inflate(
    grid: OccupancyGrid, *, robot_radius_m: float, inflation_radius_m: float, cost_scaling: float
) -> NDArray[np.uint8]:
    """Return the (H, W) uint8 costs of nav2's static and inflation layers for a grid.

    With d from a cell's centre to that of the nearest obstacle: 254 on obstacles, 253 up to the robot's
    radius r, then 252·exp(−s·(d − r)) up to the inflation radius, rounded up to whole cells as nav2 does;
    0 beyond. Unknown cells stay 255 unless a robot in them would touch an obstacle.

    Args:
        grid: The slice or the floor.
        robot_radius_m: r, the inscribed radius; 0 is a point.
        inflation_radius_m: Distance up to which there are costs; at least r.
        cost_scaling: Decay of the cost with distance, s, 1/m.

    Raises:
        DataError: A radius or the scaling is negative or not finite, or the inflation ends inside the robot.
    """
    for name, value in (("robot radius", robot_radius_m), ("cost scaling", cost_scaling)):
        if not 0.0 <= value < np.inf:
            raise DataError(f"costmap: {name} {value}; want a finite number ≥ 0")
    if not robot_radius_m <= inflation_radius_m < np.inf:
        raise DataError(
            f"costmap: inflation radius {inflation_radius_m} m, want at least the robot's {robot_radius_m} m"
        )
    cells = plane_distances(grid.cells == OCCUPIED)
    distances_m = cells * grid.resolution_m
    decay = np.exp(-cost_scaling * np.maximum(distances_m - robot_radius_m, 0.0))
    costs = ((INSCRIBED - 1) * decay).astype(np.uint8)
    costs[distances_m <= robot_radius_m] = INSCRIBED
    costs[cells > np.ceil(inflation_radius_m / grid.resolution_m)] = FREE_SPACE
    costs[grid.cells == OCCUPIED] = LETHAL
    costs[(grid.cells == UNKNOWN) & (costs < INSCRIBED)] = NO_INFORMATION
    return costs


def occupancy_values(costs: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return costs as nav2 publishes them: 0 free, 1 … 98, 99 inscribed, 100 lethal, 255 unknown."""
    table = np.zeros(256, np.uint8)
    inflated = np.arange(1, INSCRIBED)
    table[1:INSCRIBED] = 1 + (_INSCRIBED - 2) * (inflated - 1) // (INSCRIBED - 2)
    table[[INSCRIBED, LETHAL, NO_INFORMATION]] = _INSCRIBED, OCCUPIED, NO_INFORMATION
    return table[costs]


def _picture(values: NDArray[np.uint8]) -> bytes:
    """Return a PNG: redder with the cost, obstacles dark, unknown grey."""
    share = np.clip(values, 0, _INSCRIBED).astype(np.float32)[..., None] / _INSCRIBED
    bgr = (1.0 - share) * FREE_CELL[::-1] + share * (40.0, 60.0, 225.0)
    bgr[values == OCCUPIED] = OCCUPIED_CELL[::-1]
    bgr[values == NO_INFORMATION] = UNKNOWN_CELL[::-1]
    enlarged = np.kron(bgr[::-1].astype(np.uint8), np.ones((CELL_PX,) * 2 + (1,), np.uint8))
    _, encoded = cv2.imencode(".png", enlarged)
    return encoded.tobytes()


MAP, KEEPOUT, SPEED = "map", "keepout_mask", "speed_mask"
PARAMETERS, LAUNCH = "nav2_params.yaml", "map.launch.yaml"
_FILES = (PARAMETERS, LAUNCH, *(f"{stem}.*" for stem in (MAP, KEEPOUT, SPEED)))

_SLOWEST_PERCENT = 30.0
"""Speed allowed where the robot all but touches an obstacle, of its full speed."""


def nav2(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write the folder; it replaces an earlier one.

    Raises:
        DataError: The slice and the traversable floor do not cover the same cells.
        RunError: PATH holds something else.
    """
    grid, floor = run.slice, run.traversable
    keepout = with_obstacles(keepout_mask(grid, floor), run.keepout)
    slowed = slowed_percent(grid, keepout, run.config.costmap)
    with export_folder(run, path, "nav2", files=_FILES) as folder:
        write_grid(folder, MAP, grid)
        write_grid(folder, KEEPOUT, keepout)
        write_values(folder, SPEED, slowed, grid)
        parameters = _parameters(run.config.costmap, grid.resolution_m)
        write_text(folder / PARAMETERS, parameters + _datum(place_of(run)))
        write_text(folder / LAUNCH, _LAUNCH)


def keepout_mask(grid: OccupancyGrid, floor: OccupancyGrid) -> OccupancyGrid:
    """Return where a robot must not go although the map shows no obstacle: steps, slopes, drops, low heads.

    Args:
        grid: The slice.
        floor: The traversable floor, of the same voxels.

    Returns:
        A grid as large as the slice: occupied is kept out of, the rest is free.

    Raises:
        DataError: The cells of the two differ in size.
    """
    if grid.resolution_m != floor.resolution_m:
        raise DataError(f"nav2: cells of {grid.resolution_m:g} m and {floor.resolution_m:g} m; fuse again")
    offset = np.rint((floor.origin_world_m - grid.origin_world_m) / grid.resolution_m).astype(int)[::-1]
    blocked = np.zeros(grid.cells.shape, np.bool_)
    inside, own = overlap_of(offset, floor.shape, grid.shape)
    blocked[inside] = floor.cells[own] == OCCUPIED
    cells = np.where(blocked & (grid.cells != OCCUPIED), OCCUPIED, FREE).astype(np.int8)
    return OccupancyGrid(cells, grid.origin_world_m, grid.resolution_m)


def slowed_percent(grid: OccupancyGrid, keepout: OccupancyGrid, config: CostmapConfig) -> NDArray[np.uint8]:
    """Return (H, W) by how many percent of its full speed a robot is slowed: 0 far from obstacles.

    The speed falls linearly from full, at the inflation radius, to 30 % at the robot's own radius.
    """
    obstacles = (grid.cells == OCCUPIED) | (keepout.cells == OCCUPIED)
    distances_m = plane_distances(obstacles) * grid.resolution_m
    span_m = max(config.inflation_radius_m - config.robot_radius_m, grid.resolution_m)
    nearness = np.clip((config.inflation_radius_m - distances_m) / span_m, 0.0, 1.0)
    slowed = np.rint((100.0 - _SLOWEST_PERCENT) * nearness).astype(np.uint8)
    slowed[grid.cells == UNKNOWN] = 0
    return slowed


def _parameters(config: CostmapConfig, resolution_m: float) -> str:
    layers = f"""\
      global_frame: map
      robot_base_frame: base_link
      robot_radius: {config.robot_radius_m!r}
      resolution: {resolution_m!r}
      filters: ["keepout_filter", "speed_filter"]
      keepout_filter:
        plugin: "nav2_costmap_2d::KeepoutFilter"
        enabled: true
        filter_info_topic: "keepout_filter_info"
      speed_filter:
        plugin: "nav2_costmap_2d::SpeedFilter"
        enabled: true
        filter_info_topic: "speed_filter_info"
        speed_limit_topic: "speed_limit"
      inflation_layer:
        plugin: "nav2_costmap_2d::InflationLayer"
        inflation_radius: {config.inflation_radius_m!r}
        cost_scaling_factor: {config.cost_scaling!r}
"""
    return f"""\
# Parameters of nav2 for this map; {LAUNCH} gives the servers their files. Merge the costmaps into your own.
map_server:
  ros__parameters:
    frame_id: map
    topic_name: map
keepout_mask_server:
  ros__parameters:
    frame_id: map
    topic_name: keepout_mask
keepout_filter_info_server:
  ros__parameters:
    type: 0 # keep out
    filter_info_topic: keepout_filter_info
    mask_topic: keepout_mask
    base: 0.0
    multiplier: 1.0
speed_mask_server:
  ros__parameters:
    frame_id: map
    topic_name: speed_mask
speed_filter_info_server:
  ros__parameters:
    type: 1 # speed limit, percent of the full speed: base + multiplier * mask
    filter_info_topic: speed_filter_info
    mask_topic: speed_mask
    base: 100.0
    multiplier: -1.0
global_costmap:
  global_costmap:
    ros__parameters:
      plugins: ["static_layer", "inflation_layer"]
      static_layer:
        plugin: "nav2_costmap_2d::StaticLayer"
        map_topic: map
{layers}local_costmap:
  local_costmap:
    ros__parameters:
      rolling_window: true
      plugins: ["inflation_layer"] # and the layer of your own sensor
{layers}"""


def _datum(place: Georeference | None) -> str:
    """Return robot_localization's parameters for GNSS in the map's frame; empty if its place is unknown."""
    if place is None:
        return ""
    return f"""\
navsat_transform:
  ros__parameters:
    wait_for_datum: true
    datum: [{place.latitude_deg!r}, {place.longitude_deg!r}, 0.0] # the map's origin; its x points east
"""


def _server(package_node: str, name: str, mask: str = "") -> str:
    file = f'\n      - {{name: yaml_filename, value: "$(dirname)/{mask}.yaml"}}' if mask else ""
    return f"""\
- node:
    pkg: nav2_map_server
    exec: {package_node}
    name: {name}
    output: screen
    param:
      - {{from: "$(dirname)/{PARAMETERS}"}}{file}
"""


_SERVERS = {
    "map_server": ("map_server", MAP),
    "keepout_mask_server": ("map_server", KEEPOUT),
    "keepout_filter_info_server": ("costmap_filter_info_server", ""),
    "speed_mask_server": ("map_server", SPEED),
    "speed_filter_info_server": ("costmap_filter_info_server", ""),
}
_LAUNCH = (
    f"# ros2 launch {LAUNCH}: the map and its filter masks; your bringup goes on from there.\nlaunch:\n"
    + "".join(_server(node, name, mask) for name, (node, mask) in _SERVERS.items())
    + f"""\
- node:
    pkg: nav2_lifecycle_manager
    exec: lifecycle_manager
    name: lifecycle_manager_map
    output: screen
    param:
      - {{name: autostart, value: true}}
      - {{name: node_names, value: [{", ".join(_SERVERS)}]}}
"""
)
