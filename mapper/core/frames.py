"""RGB-D frames, scans, and the pinhole camera model."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points, Transform, apply, is_rigid
from mapper.core.timebase import NS_PER_S

Image = NDArray[np.uint8]
DepthImage = NDArray[np.float32]
Points32 = NDArray[np.float32]
"""(N, 3) float32 metres: within a kilometre of the sensor the rounding is below 0.1 mm."""

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """Pinhole camera with Brown–Conrady distortion; pixel centres at integers.

    Attributes:
        width_px: Image width.
        height_px: Image height.
        fx_px: Focal length along a row.
        fy_px: Focal length along a column.
        cx_px: Principal point's column.
        cy_px: Principal point's row.
        distortion: (k1, k2, p1, p2, k3) as OpenCV orders them (Brown 1966).
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float] = NO_DISTORTION

    def __post_init__(self) -> None:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion)
        if not np.isfinite(numbers).all() or self.fx_px <= 0.0 or self.fy_px <= 0.0:
            stated = ", ".join(f"{number:g}" for number in numbers)
            raise DataError(
                f"camera: fx fy cx cy and distortion {stated}: want finite numbers, focal lengths > 0"
            )
        if self.width_px < 1 or self.height_px < 1:
            raise DataError(f"camera: image of {self.width_px}×{self.height_px} px has no pixels")

    @property
    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix K in pixels."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> Array:
        """(4,) fx, fy, cx, cy in pixels."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px])

    @property
    def parameters(self) -> Array:
        """(9,) fx, fy, cx, cy in pixels and the distortion's coefficients, as compiled code takes them."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion])

    def resized(self, width_px: int, height_px: int) -> "PinholeCamera":
        """Return the camera of the same view in another size; pixel 0 is the centre of the first."""
        if (width_px, height_px) == (self.width_px, self.height_px):
            return self
        across, down = width_px / self.width_px, height_px / self.height_px
        return PinholeCamera(
            width_px,
            height_px,
            self.fx_px * across,
            self.fy_px * down,
            (self.cx_px + 0.5) * across - 0.5,
            (self.cy_px + 0.5) * down - 0.5,
            distortion=self.distortion,
        )

    def undistort(self, pixels: NDArray[np.floating]) -> Array:
        """Return the (N, 2) undistorted positions of (N, 2) measured pixels (column, row), in pixels."""
        ideal: Array = np.asarray(pixels, dtype=np.float64)
        if self.distortion == NO_DISTORTION or len(ideal) == 0:
            return ideal
        import cv2  # here and below: a run is read without images

        # Its own five iterations leave 0.1 px of error in the corners of TUM's freiburg1.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)
        ideal = cv2.undistortPoints(
            ideal.reshape(-1, 1, 2),
            self.matrix,
            np.array(self.distortion),
            P=self.matrix,
            criteria=criteria,
        ).reshape(-1, 2)
        return ideal

    def distort(self, pixels: Array) -> Array:
        """Return the (N, 2) positions of undistorted pixels in the raw image: inverse of ``undistort``."""
        if self.distortion == NO_DISTORTION or len(pixels) == 0:
            return pixels
        import cv2

        points_camera = np.column_stack([self.rays(pixels), np.ones(len(pixels))])
        measured, _ = cv2.projectPoints(
            points_camera, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion)
        )
        raw: Array = measured.reshape(-1, 2)
        return raw

    def rays(self, pixels: Array) -> Array:
        """Return the (N, 2) x/z and y/z, camera frame, of the rays of (N, 2) undistorted pixels."""
        return (pixels - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]

    def project(self, points_camera: Points) -> Array:
        """Return the undistorted pixels (N, 2) of (N, 3) camera-frame points with positive depth."""
        normalised = points_camera[:, :2] / points_camera[:, 2:3]
        return normalised * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]


@lru_cache(maxsize=8)
def ray_table(camera: PinholeCamera) -> NDArray[np.float32]:
    """Return the (H, W, 2) float32 undistorted x/z and y/z of every pixel's ray, camera frame."""
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    ideal = camera.undistort(np.column_stack([columns.ravel(), rows.ravel()]))
    return camera.rays(ideal).astype(np.float32).reshape(camera.height_px, camera.width_px, 2)


@lru_cache(maxsize=8)
def undistortion_maps(camera: PinholeCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (H, W) columns and rows in the raw image of the undistorted one's pixels, for ``cv2.remap``."""
    import cv2

    size_px = (camera.width_px, camera.height_px)
    distortion = np.array(camera.distortion)
    columns, rows = cv2.initUndistortRectifyMap(
        camera.matrix, distortion, None, camera.matrix, size_px, cv2.CV_32FC1
    )
    return columns, rows


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One cloud of returns; the source has already applied T_body_sensor.

    Attributes:
        stamp_ns: Time of capture, nanoseconds since the Unix epoch.
        points_body: (N, 3) float32, metres, body frame. Missing returns are absent, not zero.
        origin_body: (3,) float64, metres, body frame: origin of the rays.
        colors: (N, 3) uint8 RGB of each point, where the sensor has colour.
        times_s: (N,) float32 seconds after ``stamp_ns`` of each point, where the file has them.
        far_returns: Number of returns that were left out as farther than any sensor reaches.
        untimed_returns: Number of returns that were left out because their time cannot be right.
        intensities: (N,) float32 of each point, in the sensor's own unit, where the file has them.
        is_planar: All points have one z, that of the origin: a laser swept one plane parallel to x and y.
    """

    stamp_ns: int
    points_body: Points32
    origin_body: Array = field(default_factory=lambda: np.zeros(3))
    colors: NDArray[np.uint8] | None = None
    times_s: NDArray[np.float32] | None = None
    far_returns: int = 0
    untimed_returns: int = 0
    intensities: NDArray[np.float32] | None = None
    is_planar: bool = False

    def __post_init__(self) -> None:
        shape = self.points_body.shape
        if len(shape) != 2 or shape[1] != 3:
            raise DataError(f"scan {self.stamp_ns}: points {shape}, want (N, 3)")
        if self.points_body.dtype != np.float32:
            raise DataError(f"scan {self.stamp_ns}: points are {self.points_body.dtype}, want float32")
        # The extremes are finite only if every coordinate is.
        if shape[0] and not np.isfinite([self.points_body.min(), self.points_body.max()]).all():
            raise DataError(
                f"scan {self.stamp_ns}: points are not finite; drop missing returns at the source"
            )
        if self.colors is not None and self.colors.shape != shape:
            raise DataError(f"scan {self.stamp_ns}: colors {self.colors.shape}, want {shape}")
        if self.times_s is not None and self.times_s.shape != shape[:1]:
            raise DataError(f"scan {self.stamp_ns}: times {self.times_s.shape}, want {shape[:1]}")
        if self.intensities is not None and self.intensities.shape != shape[:1]:
            raise DataError(f"scan {self.stamp_ns}: intensities {self.intensities.shape}, want {shape[:1]}")

    def select(self, kept: NDArray[np.bool_]) -> "Scan":
        """Return the scan with the returns of an (N,) mask alone."""

        def some(rows: Any) -> Any:
            return None if rows is None else np.compress(kept, rows, axis=0)

        return replace(
            self,
            points_body=some(self.points_body),
            colors=some(self.colors),
            times_s=some(self.times_s),
            intensities=some(self.intensities),
        )

    def moved(self, T_new_body: Transform) -> "Scan":
        """Return the scan in the coordinates of another frame."""
        points, origin = self.points_body.astype(np.float64), self.origin_body[np.newaxis]
        return replace(
            self,
            points_body=apply(T_new_body, points).astype(np.float32),
            origin_body=apply(T_new_body, origin)[0],
            is_planar=False,
        )

    @property
    def stamp(self) -> float:
        """Time of capture, seconds, for plots: Unix time is rounded by up to 120 ns."""
        return self.stamp_ns / NS_PER_S

    @property
    def checksum(self) -> int | None:
        """Number by which clouds differ: a frozen sensor's have the same; None of an empty one."""
        if len(self.points_body) == 0:
            return None
        return int(isal_zlib.crc32(np.ascontiguousarray(self.points_body)))

    @property
    def points(self) -> Points32:
        """(N, 3) float32, metres, body frame: ``points_body``."""
        return self.points_body

    def scan(self) -> "Scan":
        """Return the scan itself: frames of every kind can be converted to a scan."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points with a colour each; ``numpy.asarray(cloud)`` gives the points.

    Attributes:
        points: (N, 3) float32, metres, levelled world: z up, floor at 0.
        colors: (N, 3) uint8 RGB.
        intensities: (N,) float32 in the sensor's own unit; None where the log has none.
        times_s: (N,) float32, when each was first seen, seconds after the run's first pose; None if unknown.
    """

    points: Points32
    colors: NDArray[np.uint8]
    intensities: NDArray[np.float32] | None = None
    times_s: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        more = ["colours", *(name for name in ("intensities", "times_s") if getattr(self, name) is not None)]
        return f"Cloud of {len(self)} points with {', '.join(more)}"

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.points, dtype=dtype, copy=copy)

    def select(self, kept: NDArray[np.bool_]) -> "Cloud":
        """Return the cloud with the points of an (N,) mask alone."""
        return Cloud(
            np.compress(kept, self.points, axis=0),
            np.compress(kept, self.colors, axis=0),
            None if self.intensities is None else self.intensities[kept],
            None if self.times_s is None else self.times_s[kept],
        )


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFrame:
    """One colour or grey image with registered depth.

    Attributes:
        stamp_ns: Time of the image, nanoseconds since the Unix epoch.
        image: (H, W, 3) uint8 RGB, or (H, W) uint8 grey.
        depth_m: (H, W) float32 depth along the optical axis, metres; 0 is no measurement.
        camera: Intrinsics that hold for both images.
        T_body_camera: (4, 4) pose of the camera in the body frame.
        depth_delay_s: Time from the image's stamp to the depth image's.
        is_depth_moved: The depth image is another camera's, registered, and lacks some of its returns.
    """

    stamp_ns: int
    image: Image
    depth_m: DepthImage
    camera: PinholeCamera
    T_body_camera: Transform = field(default_factory=lambda: np.eye(4))
    depth_delay_s: float = 0.0
    is_depth_moved: bool = False

    def __post_init__(self) -> None:
        want = (self.camera.height_px, self.camera.width_px)
        if self.image.shape[:2] != want or self.image.shape[2:] not in ((), (3,)):
            raise DataError(f"frame {self.stamp_ns}: image {self.image.shape}, the camera has {want}")
        if self.depth_m.shape != want:
            raise DataError(f"frame {self.stamp_ns}: depth {self.depth_m.shape}, the camera has {want}")
        if not is_rigid(self.T_body_camera):
            raise DataError(f"frame {self.stamp_ns}: T_body_camera is not a rigid motion")

    @property
    def stamp(self) -> float:
        """Time of the image, seconds, for plots: Unix time is rounded by up to 120 ns."""
        return self.stamp_ns / NS_PER_S

    @property
    def depth_stamp_ns(self) -> int:
        """Time of the depth image, nanoseconds."""
        return self.stamp_ns + round(self.depth_delay_s * NS_PER_S)

    @property
    def image_checksum(self) -> int | None:
        """Number by which images differ: a frozen camera's have the same; None of an image of one shade."""
        return _checksum(self.image)

    @property
    def depth_checksum(self) -> int | None:
        """As ``image_checksum``, of the depth image."""
        return _checksum(self.depth_m)

    @property
    def gray(self) -> Image:
        """(H, W) uint8 luminance."""
        if self.image.ndim == 2:
            return self.image
        import cv2

        gray: Image = cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY)
        return gray

    @property
    def rgb(self) -> Image:
        """(H, W, 3) uint8 RGB; a grey image repeats its one channel."""
        if self.image.ndim == 3:
            return self.image
        return np.repeat(self.image[:, :, None], 3, axis=2)

    def scan(self, *, stride_px: int = 1, max_depth_m: float = np.inf) -> Scan:
        """Return the measured pixels as a scan in the body frame, with the colours of a colour image.

        Args:
            stride_px: Keep every n-th row and column.
            max_depth_m: Drop deeper measurements.
        """
        from mapper.core.back_projection import back_project  # numba takes long to import

        points_body = back_project(
            self.depth_m,
            ray_table(self.camera),
            self.T_body_camera,
            stride_px=stride_px,
            max_depth_m=max_depth_m,
        )
        colors = None
        if self.image.ndim == 3:
            depth_m = self.depth_m[::stride_px, ::stride_px].ravel()
            pixels = self.image[::stride_px, ::stride_px].reshape(-1, 3)
            colors = np.compress((depth_m > 0.0) & (depth_m <= max_depth_m), pixels, axis=0)
        return Scan(
            stamp_ns=self.stamp_ns,
            points_body=points_body,
            origin_body=self.T_body_camera[:3, 3],
            colors=colors,
        )


Frame = RgbdFrame | Scan


Sensor = Literal["rgbd", "lidar", "lidar-2d"]
"""Kind of a log's sensor: RGB-D frames whose body is an optical frame, scans with z roughly up, or planar
scans, whose body moves in the plane of x and y."""


def _checksum(image: Image | DepthImage) -> int | None:
    first = image.flat[0]
    if (image[0] == first).all() and (image == first).all():  # the first row decides it for nearly all images
        return None
    return int(isal_zlib.crc32(np.ascontiguousarray(image)))
