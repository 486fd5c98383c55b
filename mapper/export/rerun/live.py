"""A build as a Rerun recording while it runs.

The estimates of tracking are logged below /world/live, in a world that is upright only by guess; once the
graph is solved and levelled, that entity gets its pose in the levelled world. The body keeps the odometry's
poses: Rerun would not show poses that are logged anew at the same stamps.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import rerun as rr

from mapper.config.build import RerunConfig
from mapper.core.errors import FrameError
from mapper.core.frames import RgbdFrame, Scan, Sensor
from mapper.core.geometry import Array, Transform, inverse
from mapper.export.figures import ACCEPTED, ESTIMATE, FACTORS, REJECTED, START, Rgb
from mapper.export.rerun.finished import about_text, extent, log_run
from mapper.export.rerun.recording import THIN_PX, RerunLog, recorded, transform_of
from mapper.features.frame_view import ImageView
from mapper.mapping.map_building import Maps
from mapper.mapping.thumbnails import encode_jpeg, shrunk_camera
from mapper.odometry.base import FeatureMatches, FrameResult
from mapper.run.folder import Run
from mapper.run.observers import Step
from mapper.run.results import RunResults
from mapper.sources.base import Log

_LIVE = "world/live"
_BODY = f"{_LIVE}/body"
_GROWTH = 0.02  # a path is logged anew once it has grown by this share: so in all 50 times its length
_IMAGE_WIDTH_PX = 480
_LOGGED_DIAGNOSTICS = ("features", "matches", "inliers", "residual")
_UPRIGHT: dict[Sensor, Transform] = {
    # x right, y down, z forward, held level, becomes x right, y forward, z up.
    "rgbd": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
    "lidar": np.eye(4),
    "lidar-2d": np.eye(4),
}


class LiveRerun:
    """Observer that logs a build to a recording; made by :func:`live_recording`."""

    def __init__(self, log: RerunLog, sensor: Sensor, config: RerunConfig) -> None:
        self._log = log
        self._config = config
        self._T_guess_world = _UPRIGHT[sensor]
        self._frames = 0
        self._last_ns = 0
        self._path: list[Array] = []
        self._nodes: list[int] = []
        self._factors: list[tuple[int, int]] = []
        self._logged_nodes = 0
        self._logged_loops = 0

    def on_frame(self, step: Step, /) -> None:
        """Log where the body is and how tracking went; now and then the image, the cloud and the paths."""
        track = step.track
        self._last_ns = track.stamp_ns
        self._log.keeps = True  # a build that fails is best understood by looking at it
        for name in _LOGGED_DIAGNOSTICS:
            value = float(getattr(track.diagnostics, name))
            self._log.log(f"diagnostics/{name}", rr.Scalars(value), stamp_ns=track.stamp_ns)
        if track.node is not None:
            self._move(track)
        if self._frames % self._config.image_stride == 0:
            self._show(step)
        self._frames += 1
        if track.is_keyframe and track.node is not None:
            self._nodes.append(track.node)
            self._factors += [(factor.i, factor.j) for factor in (*track.links, *track.factors)]
            self._log_paths(step)

    def on_levelled(self, T_level_world: Transform, /) -> None:
        """Log the pose of everything logged so far in the levelled world."""
        self._log.log(_LIVE, transform_of(T_level_world @ inverse(self._T_guess_world)))

    def on_mapped(self, run: Run, results: RunResults, maps: Maps, /) -> None:
        """Log the results and clear the estimates made during tracking."""
        for name in ("estimates", "factors", "loops"):
            self._log.log(f"{_LIVE}/{name}", rr.Clear(recursive=True), stamp_ns=self._last_ns)
        log_run(self._log, results, maps)
        self._log.about(about_text(run, name=run.manifest.input.title))
        self._log.look_at(extent(results, maps))

    def _move(self, track: FrameResult) -> None:
        T_guess_body = self._T_guess_world @ track.T_world_body
        self._path.append(T_guess_body[:3, 3].astype(np.float32))
        self._log.log(self._log.body, transform_of(T_guess_body), stamp_ns=track.stamp_ns)

    def _show(self, step: Step) -> None:
        try:
            frame = step.entry.load()
        except FrameError:
            return  # it was readable in the first pass; fusing reports it
        if isinstance(frame, RgbdFrame):
            self._show_image(frame, step)
            pixels = frame.depth_m.size
            self._show_cloud(frame.scan(stride_px=_stride(pixels, self._config.cloud_points, power=2)))
        else:
            self._show_cloud(frame)

    def _show_image(self, frame: RgbdFrame, step: Step) -> None:
        camera = shrunk_camera(frame.camera, width_px=_IMAGE_WIDTH_PX)
        if self._frames == 0:
            self._log.mount(camera, frame.T_body_camera)
        jpeg = encode_jpeg(frame.image, width_px=_IMAGE_WIDTH_PX)
        image = rr.EncodedImage(contents=jpeg, media_type="image/jpeg")
        self._log.log(self._log.camera, image, stamp_ns=frame.stamp_ns)
        view = step.view()
        if isinstance(view, ImageView):
            scale = camera.width_px / frame.camera.width_px
            self._show_features(view, step.matches(), lambda px: (frame.camera.distort(px) + 0.5) * scale)

    def _show_features(
        self, view: ImageView, matches: FeatureMatches | None, drawn: Callable[[Array], Array]
    ) -> None:
        """Log the features, the inliers in another colour, and lines from the inliers' previous pixels."""
        nothing = FeatureMatches(np.zeros(len(view), np.bool_), np.full((len(view), 2), np.nan))
        held = matches or nothing
        dots = rr.Points2D(
            drawn(view.pixels),
            colors=np.where(held.is_inlier[:, None], np.array(START, np.uint8), np.array(REJECTED, np.uint8)),
            radii=rr.Radius.ui_points(1.5),
        )
        moved = np.isfinite(held.previous_px[:, 0])
        chain = np.stack([drawn(held.previous_px[moved]), drawn(view.pixels[moved])], axis=1)
        lines = rr.LineStrips2D(chain, colors=[START], radii=THIN_PX)
        self._log.log(f"{self._log.camera}/features", dots, stamp_ns=view.stamp_ns)
        self._log.log(f"{self._log.camera}/matches", lines, stamp_ns=view.stamp_ns)

    def _show_cloud(self, scan: Scan) -> None:
        kept = slice(None, None, _stride(len(scan.points_body), self._config.cloud_points, power=1))
        colors = None if scan.colors is None else scan.colors[kept]
        points = rr.Points3D(scan.points_body[kept], colors=colors, radii=rr.Radius.ui_points(1.0))
        self._log.log(f"{self._log.body}/cloud", points, stamp_ns=scan.stamp_ns)

    def _log_paths(self, step: Step) -> None:
        """Log the path before loops, the current node estimates and the factors; not for every keyframe."""
        loops = step.detector.closures()
        grown = len(self._nodes) >= (1.0 + _GROWTH) * self._logged_nodes
        if not grown and len(loops) == self._logged_loops:
            return
        self._logged_nodes, self._logged_loops = len(self._nodes), len(loops)
        positions = {
            node: (self._T_guess_world @ step.detector.current_estimate(node))[:3, 3] for node in self._nodes
        }
        self._strips("odometry", [np.array(self._path)], FACTORS["odometry"])
        self._strips("estimates", [np.array(list(positions.values()))], ESTIMATE)
        self._strips(
            "factors",
            [[positions[i], positions[j]] for i, j in self._factors],
            FACTORS["odometry"],
        )
        for verdict, color in (("accepted", ACCEPTED), ("rejected", REJECTED)):
            ends = [
                [positions[loop.i], positions[loop.j]]
                for loop in loops
                if loop.verdict == verdict and loop.i in positions and loop.j in positions
            ]
            self._strips(f"loops/{verdict}", ends, color)

    def _strips(self, name: str, strips: Sequence[Sequence[Array] | Array], color: Rgb) -> None:
        lines = rr.LineStrips3D(strips, colors=[color], radii=rr.Radius.ui_points(1.0))
        self._log.log(f"{_LIVE}/{name}", lines, stamp_ns=self._last_ns)


@contextmanager
def live_recording(target: str, source: Log, config: RerunConfig) -> Iterator[LiveRerun]:
    """Yield an observer that logs to a target; a build that fails leaves what it recorded.

    Args:
        target: FILE.rrd, "spawn", "connect" or "connect:URL".
        source: The log that is mapped.
        config: Settings of what is shown.

    Raises:
        ConfigError: The target is none.
        ViewerError: No viewer can be started or reached.
    """
    has_images = source.sensor == "rgbd"
    with recorded(target, name=source.name, has_images=has_images, body=_BODY) as log:
        yield LiveRerun(log, source.sensor, config)


def _stride(items: int, wanted: int, *, power: int) -> int:
    """Return the stride, the same along each of ``power`` axes, that leaves about ``wanted`` items."""
    ratio: float = (items / wanted) ** (1.0 / power)
    return max(1, round(ratio))
