"""Settings of a log: which part is used, and what its files do not state."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config

OffsetS = Annotated[float, Field(ge=-4e9, le=4e9)]
"""Seconds that are added to stamps: farther than any two clocks are apart, and the sum fits into 64 bits of
nanoseconds."""


class CameraConfig(Config):
    """Intrinsics, all four, and depth units that override what the log or its folder's name says."""

    fx_px: PositiveFloat | None = None
    """Focal length along the image's rows. None keeps the log's own, as in the other three."""
    fy_px: PositiveFloat | None = None
    """Focal length along the image's columns."""
    cx_px: float | None = None
    """Column of the principal point."""
    cy_px: float | None = None
    """Row of the principal point."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 (OpenCV's order)."""
    depth_factor: PositiveFloat | None = None
    """Depth image units per metre; None keeps the log's own (TUM's 5000, 1 of 32-bit depth in recordings)."""
    depth_intrinsics_px: tuple[PositiveFloat, PositiveFloat, float, float] | None = None
    """fx, fy, cx, cy of the depth camera, where depth images are not registered to colour: they are as they
    are read. None keeps the log's own."""
    depth_distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of the depth camera; goes with ``depth_intrinsics_px``."""
    depth_in_color: tuple[float, float, float, float, float, float, float] | None = None
    """x y z (metres) qx qy qz qw of the depth camera in the colour camera's optical frame; None is the pose
    that the log states. 0 0 0 0 0 0 1 says that depth is registered, if its intrinsics are colour's."""

    @property
    def intrinsics_px(self) -> tuple[float, float, float, float] | None:
        """fx, fy, cx and cy; None where they are the log's own."""
        if self.fx_px is None or self.fy_px is None or self.cx_px is None or self.cy_px is None:
            return None
        return self.fx_px, self.fy_px, self.cx_px, self.cy_px

    @model_validator(mode="after")
    def _intrinsics_are_whole(self) -> Self:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        given = any(number is not None for number in numbers) or any(self.distortion)
        if given and self.intrinsics_px is None:
            raise ValueError("want fx_px, fy_px, cx_px and cy_px, all four; depth_factor may stand alone")
        if any(self.depth_distortion) and self.depth_intrinsics_px is None:
            raise ValueError("depth_distortion is given without depth_intrinsics_px")
        if self.depth_in_color is not None and not any(self.depth_in_color[3:]):
            raise ValueError(f"depth_in_color {self.depth_in_color}: its quaternion is zero")
        return self


class TopicsConfig(Config):
    """Topics of an MCAP file or a ROS bag that are read; None is guessed, and reported."""

    color: str | None = None
    """Colour or grey images."""
    depth: str | None = None
    """Depth images, registered to the colour images."""
    camera_info: str | None = None
    """Calibration of the colour camera."""
    points: str | None = None
    """Point clouds; if set, they are mapped even if there are RGB-D images too."""
    imu: str | None = None
    """Inertial readings, whose accelerations show which way is up."""
    gyroscope: str | None = None
    """Inertial readings whose angular velocities are used; None is the same topic, or one that has them."""
    gnss: str | None = None
    """Fixes of a GNSS receiver (NavSatFix, GPSFix, or sentences of NMEA); None is guessed: a receiver's
    rather than a filter's."""
    truth: str | None = None
    """True poses (Odometry, PoseStamped, TransformStamped), or ``tf:FRAME``: the body's in a frame of tf, as
    motion capture has them; None is /ground_truth, if there is one."""
    wheels: str | None = None
    """Wheel odometry (Odometry, PoseStamped, TransformStamped); None is /wheel_odometry, if there is one."""
    others: Literal["tracked", "fused", "unused"] = "fused"
    """Whether other LiDARs and the RGB-D camera beside the sensor that is tracked are fused into the maps, at
    the poses of its path, where tf says how they are mounted. "tracked" also merges the scans of 3D LiDARs
    into those of the tracked one, for tracking: for narrow views, in directions of their own."""


class WheelsConfig(Config):
    """Kinematics of a log's wheels."""

    wheelbase_m: PositiveFloat | None = None
    """Distance between the axles; required for a log's encoders.txt, not for its wheels.txt."""
    body_in_base: tuple[float, float, float, float, float, float, float] | None = None
    """x y z (metres) qx qy qz qw of the body in the frame of the wheels, x forward, y left, z up; None is the
    pose from tf, or else the origin, looking forward."""


class BodyConfig(Config):
    """The sensor's own vehicle, whose returns no part of mapper gets to see: neither tracking nor maps."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Least x y z, then largest x y z, metres, body frame: returns inside are the vehicle's or driver's."""
    find_box: bool = True
    """Without a box a build finds that of returns that stand still near the sensor while it moves."""
    min_range_m: NonNegativeFloat = 0.0
    """Nearer returns are left out."""
    max_range_m: PositiveFloat | None = None
    """Farther returns are left out, and free no space either: see ``octree.max_range_m`` for that."""

    @property
    def finds_box(self) -> bool:
        """Whether the box is to be found."""
        return self.find_box and self.box is None

    @property
    def clears(self) -> bool:
        """Whether any return may be left out."""
        return self.box is not None or self.min_range_m > 0.0 or self.max_range_m is not None

    @model_validator(mode="after")
    def _is_not_empty(self) -> Self:
        if self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise ValueError(f"box {self.box}: want the least x y z, then the largest x y z")
        if self.max_range_m is not None and self.max_range_m <= self.min_range_m:
            raise ValueError(f"max_range_m {self.max_range_m} must be above min_range_m {self.min_range_m}")
        return self


class SourceConfig(Config):
    """The selection every kind of log understands."""

    first_frame: NonNegativeInt = 0
    """Index of the first frame to use."""
    last_frame: NonNegativeInt | None = None
    """Index of the last frame to use, inclusive; None is the end of the log."""
    stride: PositiveInt = 1
    """Use every n-th frame. More is faster, and loses track where the sensor moves fast."""
    require_truth: bool = False
    """Leave out frames without ground truth within ``max_truth_gap_s``, so that a comparison covers all
    frames used."""
    max_truth_gap_s: NonNegativeFloat = 0.02
    """Largest time between a frame and a pose of the truth that are compared. Raise it if the truth has fewer
    poses per second than the log has frames."""
    max_pair_gap_s: NonNegativeFloat = 0.02
    """Largest time between a colour image and its depth image. Raise it if the two are not synchronised and
    the camera moves slowly; frames without a partner are left out."""
    depth_offset_s: OffsetS | None = None
    """Added to the stamps of depth images before they are paired with colour images: how much later they show
    the scene than their stamps say. None pairs them as stamped, and fuses them at the time that the images
    show. ``mapper inspect --time-offset`` measures it, and the next four."""
    imu_offset_s: OffsetS = 0.0
    """Added to the stamps of accelerations and angular velocities."""
    wheels_offset_s: OffsetS = 0.0
    """Added to the stamps of wheel odometry."""
    truth_offset_s: OffsetS = 0.0
    """Added to the stamps of the true poses."""
    images_offset_s: OffsetS = 0.0
    """Added to the stamps of the images that colour a LiDAR's cloud."""
    rate_hz: PositiveFloat | None = None
    """Frames per second of numbered files without stamps; None is the format's own (30, Poznań, scans 10)."""
    camera: CameraConfig | None = None
    """Intrinsics and depth units; None keeps the log's own."""
    topics: TopicsConfig = TopicsConfig()
    wheels: WheelsConfig = WheelsConfig()
    body: BodyConfig = BodyConfig()
    body_frame: str | None = None
    """Frame in a recording's tf that is a LiDAR's body, e.g. base_link; None is the cloud's own frame.
    The body of RGB-D frames is the camera: there it is the frame whose poses are in base.tum; None is
    base_link or base_footprint, where tf has it."""
    pattern: str | None = None
    """Glob of the names of a LiDAR log's clouds, e.g. ``os1_*.bin``; None is all with the usual ending."""
    stamps_file: Path | None = None
    """File with one stamp per line and cloud, seconds or nanoseconds; None looks for stamps in names, then
    for times.txt."""
    truth_file: Path | None = None
    """Poses of a LiDAR log, in TUM's, KITTI's or MulRan's text or a table with a header; None looks for
    groundtruth.txt, poses.txt, and tables of poses or positions that are called truth."""
    cloud_scale: PositiveFloat | None = None
    """Metres per unit of a LiDAR log's points; None is 1, and refuses what looks like millimetres."""
    bin_columns: int | None = Field(default=None, ge=3, le=64)
    """float32 numbers of a point in a LiDAR log's .bin files, of which the first three are x y z, e.g. 8
    for padded ones; None is KITTI's 4, or 5 and 6 with rings, and refuses what shows another number."""
    point_time_scale: float = 1.0
    """Factor on the times of a LiDAR's points: 0 for scans that were deskewed already, -1 for times that
    count backwards, 0.1 for shares of sweeps of 0.1 s. The warning ``sweep`` reports the last."""
    sweep_s: PositiveFloat | None = None
    """Duration of one turn of a spinning LiDAR whose points have no times: they get times by their azimuth
    from the first point of the file, and are deskewed. Of a LAS strip, the duration of the sweeps that it is
    cut into; None is that of a turn, or 0.1 s."""
