"""Foxglove layout of a run's MCAP file: import it in Foxglove's layout menu, then open ``run.mcap``."""

from pathlib import Path

import foxglove.layouts as fl

from mapper.export.figures import ESTIMATE, PLAN, TRUTH, Rgb, hex_of
from mapper.export.transforms import root_of
from mapper.run import files
from mapper.run.folder import Run
from mapper.runtime.atomic import write_text
from mapper.runtime.progress import Progress

_CURVES = (
    ("features", ("features", "matches", "inliers")),
    ("ms per frame", ("ms",)),
    ("residual", ("residual",)),
)


def layout(run: Run, path: Path, _progress: Progress) -> None:
    """Write the layout of a run: the map at the left, the images, the curves and the loops at the right."""
    map_frame, body = root_of(run.file(files.MCAP))
    write_text(path, layout_json(run.config.octree.resolution_m, map_frame=map_frame, body=body) + "\n")


def layout_json(voxel_m: float, *, map_frame: str, body: str) -> str:
    """Return the layout as JSON.

    Args:
        voxel_m: Edge of the map's voxels.
        map_frame: Name of the levelled world.
        body: Name of the frame that moves in it.
    """
    right = fl.SplitContainer(
        direction="column",
        items=[
            fl.SplitItem(proportion=3, content=_image()),
            *(fl.SplitItem(proportion=2, content=_plot(title, fields)) for title, fields in _CURVES),
            fl.SplitItem(proportion=2, content=_loops()),
        ],
    )
    content = fl.SplitContainer(
        direction="row",
        items=[
            fl.SplitItem(proportion=3, content=_map(voxel_m, map_frame, body)),
            fl.SplitItem(proportion=2, content=right),
        ],
    )
    text: str = fl.Layout(content=content).to_json()
    return text


def _map(voxel_m: float, map_frame: str, body: str) -> fl.ThreeDeePanel:
    hidden = fl.BaseRendererPointCloudTopicSettings(visible=False)
    topics = {
        "/map/octree": fl.BaseRendererPointCloudTopicSettings(
            visible=True, point_shape="cube", cube_size=voxel_m, color_mode="rgba-fields"
        ),
        "/map/cloud": fl.BaseRendererPointCloudTopicSettings(
            visible=False, point_size=2.0, color_mode="rgba-fields"
        ),
        "/map/dynamic": fl.BaseRendererPointCloudTopicSettings(
            visible=False, point_size=2.0, color_mode="rgba-fields"
        ),
        "/map/slice": fl.BaseRendererRosOccupancyGridTopicSettings(visible=True, color_mode="map", alpha=0.8),
        "/map/traversable": fl.BaseRendererRosOccupancyGridTopicSettings(visible=False, color_mode="costmap"),
        "/trajectory/estimate": _line(ESTIMATE),
        "/trajectory/truth": _line(TRUTH),
        "/plan": _line(PLAN),
        "/graph/factors": fl.BaseRendererSceneUpdateTopicSettings(visible=True),
        "/camera/calibration": fl.BaseRendererCameraTopicSettings(visible=True, distance=0.3),
        # Lines as dots, for a viewer that draws no lines.
        "/trajectory/estimate/dots": hidden,
        "/trajectory/truth/dots": hidden,
        "/plan/dots": hidden,
        "/pose": hidden,
        "/graph/factors/dots": hidden,
    }
    return fl.ThreeDeePanel(
        title="map",
        config=fl.ThreeDeeConfig(
            fixed_frame=map_frame,
            follow_tf=body,
            follow_mode="follow-none",
            camera_state=fl.ThreeDeeCameraState(distance=12.0, phi=50.0, theta_offset=30.0, perspective=True),
            layers={"grid": fl.BaseRendererGridLayerSettings(visible=True, size=20.0, divisions=20.0)},
            topics=topics,
        ),
    )


def _line(color: Rgb) -> fl.BaseRendererPosesTopicSettings:
    ends = (f"{hex_of(color)}ff",) * 2
    return fl.BaseRendererPosesTopicSettings(visible=True, type="line", line_width=0.02, gradient=ends)


def _image() -> fl.ImagePanel:
    mode = fl.ImageModeConfig(image_topic="/camera/image", calibration_topic="/camera/calibration")
    return fl.ImagePanel(title="camera", config=fl.ImageConfig(image_mode=mode))


def _plot(title: str, fields: tuple[str, ...]) -> fl.PlotPanel:
    series = [fl.PlotSeries(value=f"/diagnostics.{field}", label=field, enabled=True) for field in fields]
    return fl.PlotPanel(title=title, config=fl.PlotConfig(paths=series, show_legend=True, is_synced=True))


def _loops() -> fl.RawMessagesPanel:
    return fl.RawMessagesPanel(config=fl.RawMessagesConfig(topic_path="/loops", default_expanded=True))
