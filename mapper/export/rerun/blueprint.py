"""Rerun blueprint: the arrangement of views for a recording."""

import numpy as np
import rerun.blueprint as rrb

from mapper.core.geometry import Array

_DIRECTION = np.array([-0.6, -1.0, 0.9])  # from what is looked at to the eye
_DISTANCE = 0.85  # in diagonals of what is looked at


def blueprint_for(looking_at: Array | None, camera: str | None) -> rrb.Blueprint:
    """Return the map at the left, the images, the plan and the curves at the right.

    Args:
        looking_at: (2, 3) lower and upper corner of what the 3D views look at first, metres.
        camera: The entity whose images are shown; None leaves no room for images.
    """
    eye = None if looking_at is None else _eye(looking_at)
    everything = ["+ /world/**", "- /world/map/traversable"]
    maps = rrb.Tabs(
        rrb.Spatial3DView(
            name="voxels", origin="/world", contents=[*everything, "- /world/map/cloud"], eye_controls=eye
        ),
        rrb.Spatial3DView(
            name="cloud",
            origin="/world",
            contents=[*everything, "- /world/map/voxels", "- /world/map/slice"],
            eye_controls=eye,
        ),
    )
    images = [] if camera is None else [rrb.Spatial2DView(name="camera", origin=camera)]
    right = rrb.Vertical(
        *images,
        rrb.Tabs(
            rrb.Spatial2DView(name="slice", origin="/slice"),
            rrb.TextDocumentView(name="about", origin="/about"),
            rrb.TextLogView(name="loops", origin="/log"),
        ),
        rrb.TimeSeriesView(
            name="features",
            origin="/diagnostics",
            contents=["+ $origin/features", "+ $origin/matches", "+ $origin/inliers"],
        ),
        rrb.Tabs(
            rrb.TimeSeriesView(name="ms per frame", origin="/diagnostics/ms"),
            rrb.TimeSeriesView(name="residual", origin="/diagnostics/residual"),
        ),
        row_shares=[*(3 for _ in images), 3, 2, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(maps, right, column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="stamp"),
        auto_views=False,
    )


def _eye(corners: Array) -> rrb.EyeControls3D:
    low, high = corners
    centre = (low + high) / 2.0
    distance_m = _DISTANCE * float(np.linalg.norm(high - low))
    return rrb.EyeControls3D(
        position=centre + distance_m * _DIRECTION / np.linalg.norm(_DIRECTION),
        look_target=centre,
        eye_up=[0.0, 0.0, 1.0],
    )
