"""Settings of the traversable floor, the costmap and path planning."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapper.core.config import Config


class TraversableConfig(Config):
    """Settings of the floor that a wheeled robot can drive on."""

    floor: Literal["surfaces", "layer"] = "surfaces"
    """Where floor is: surfaces that the sensor saw; or where it saw free space, as a 2D laser sees no floor:
    every column with free and without occupied voxels, of which any is an obstacle."""
    max_step_m: PositiveFloat = 0.1
    """Higher steps, up or down, are obstacles; in whole voxels, of which one is within a floor's noise."""
    max_slope_rad: Annotated[float, Field(gt=0.0, lt=1.5)] = 0.35
    """Steeper floors are obstacles."""
    slope_window_m: PositiveFloat = 0.6
    """The slope is that of the plane through the floor in a square of this edge."""
    head_room_m: PositiveFloat = 1.2
    """A floor with something occupied less than this above it is an obstacle: the robot's height."""
    robot_radius_m: NonNegativeFloat = 0.0
    """Floor nearer than this to an obstacle is not traversable; 0 leaves that to the planner."""
    footprint_m: NonNegativeFloat = 0.3
    """Half the width of the sensor's carrier: the floor that it swept is free where nothing was seen."""
    max_gap_m: NonNegativeFloat = 0.1
    """Unknown gaps in the floor up to this width, such as rays along the floor leave, are closed."""


class CostmapConfig(Config):
    """Settings of nav2's inflation of the slice; its defaults but for the radius."""

    robot_radius_m: NonNegativeFloat = 0.2
    """Inscribed radius: least distance of the robot's centre to an obstacle."""
    inflation_radius_m: NonNegativeFloat = 0.55
    """Distance to obstacles beyond which there is no cost."""
    cost_scaling: NonNegativeFloat = 10.0
    """Rate, per metre, at which the cost falls with the distance."""


class PlanConfig(Config):
    """Settings of path planning for a disc on a grid or a ball in the octree."""

    radius_m: NonNegativeFloat = 0.2
    """Radius of the disc, or of the ball."""
    unknown: Literal["blocked", "free"] = "blocked"
    """Unknown space counts as blocked or as free."""
    layer: Literal["slice", "traversable"] = "slice"
    """Grid on which a path in 2D is planned."""
