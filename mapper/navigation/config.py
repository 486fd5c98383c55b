"""What a robot can do: where it can stand, and how its paths are planned."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapper.core.config import Config


class TraversableConfig(Config):
    """The floor that a wheeled robot can drive on."""

    max_step_m: PositiveFloat = 0.1
    """Higher steps, up or down, are obstacles; whole voxels count, and one is within a floor's noise."""
    max_slope_rad: Annotated[float, Field(gt=0.0, lt=1.5)] = 0.35
    """Steeper floors are obstacles."""
    slope_window_m: PositiveFloat = 0.6
    """The slope is that of the plane through the floor in a square of this edge."""
    head_room_m: PositiveFloat = 1.2
    """A floor with something occupied less than this above it is an obstacle: the robot's height."""
    robot_radius_m: NonNegativeFloat = 0.0
    """Floor nearer than this to an obstacle is taken from the robot; 0 leaves that to the planner."""
    max_gap_m: NonNegativeFloat = 0.1
    """Floor goes on over unseen columns up to this wide, which rays along the floor leave."""


class CostmapConfig(Config):
    """The slice inflated as nav2's costmap does; its defaults but the radius."""

    robot_radius_m: NonNegativeFloat = 0.2
    """Inscribed radius: nearer to an obstacle the robot's centre cannot be."""
    inflation_radius_m: NonNegativeFloat = 0.55
    """How far from obstacles there is a cost at all."""
    cost_scaling: NonNegativeFloat = 10.0
    """Per metre: how fast the cost falls with the distance."""


class PlanConfig(Config):
    """A path for a disc on a grid or a ball in the octree."""

    radius_m: NonNegativeFloat = 0.2
    unknown: Literal["blocked", "free"] = "blocked"
    """What unknown space counts as."""
    layer: Literal["slice", "traversable"] = "slice"
    """Which grid a path in 2D is planned on."""
