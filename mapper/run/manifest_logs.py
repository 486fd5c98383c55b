"""Logs of a run as its manifest keeps them: where they are, what was noted, and where the sensors were."""

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from mapper.core.config import Config
from mapper.core.errors import RunError
from mapper.core.geometry import Transform, inverse
from mapper.core.rotations import pose_of_row, row_of_pose
from mapper.core.trajectory import NO_POSES, Trajectory, carried
from mapper.odometry.gyroscope_calibration import GyroscopeCalibration, with_body_rates
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig


class GyroscopeFit(Config):
    """Calibration of the log's gyroscope, by which scans are deskewed."""

    R_body_imu: tuple[tuple[float, float, float], ...]
    bias_radps: tuple[float, float, float]
    offset_s: float
    """Added to the frames' stamps it gives the readings'."""
    scale: float
    """Factor from the readings to rad/s; negative where their axes are left-handed."""

    @classmethod
    def of(cls, calibration: GyroscopeCalibration) -> Self:
        """Return the record of a calibration."""
        return cls(
            R_body_imu=calibration.R_body_imu.tolist(),
            bias_radps=calibration.bias.tolist(),
            offset_s=calibration.offset_s,
            scale=calibration.scale,
        )

    @property
    def calibration(self) -> GyroscopeCalibration:
        """The calibration, without its uncertainty."""
        return GyroscopeCalibration(
            np.array(self.R_body_imu), np.array(self.bias_radps), self.offset_s, self.scale, np.zeros((7, 7))
        )

    def applied_to(self, log: Log) -> Log:
        """Return a log with the readings of its gyroscope calibrated."""
        return with_body_rates(log, self.calibration)


PoseNumbers = tuple[float, float, float, float, float, float, float]
"""x y z (metres) qx qy qz qw."""


class SensorFrame(Config):
    """Coordinate frame of a sensor that stays on the robot."""

    name: str
    parent: str
    """The body's name, or the base's where the body moves on that."""
    pose_in_parent: PoseNumbers

    @property
    def mounting(self) -> Transform:
        """T_parent_sensor, (4, 4)."""
        return pose_of_row(np.array(self.pose_in_parent))


class RobotFrames(Config):
    """Coordinate frames of a robot in a log, and where its sensors are."""

    base: str = ""
    """Name of the robot's base, e.g. base_link; empty where the log does not say where the body is on it."""
    body: str = ""
    """Name of the frame whose poses are the run's trajectory; empty where the log does not name it."""
    body_in_base: PoseNumbers | None = None
    """None where it moves there."""
    sensors: tuple[SensorFrame, ...] = ()

    @classmethod
    def of(cls, log: Log) -> Self | None:
        """Return those of a log; None where it names none."""
        row = None if log.T_base_body is None else row_of_pose(log.T_base_body).tolist()
        base = log.base_frame if row or log.T_body_base else ""
        sensors = tuple(
            SensorFrame(name=s.frame, parent=s.parent, pose_in_parent=row_of_pose(s.T_parent_sensor).tolist())
            for s in log.sensors
            if s.parent in (log.body_frame, base)
        )
        found = cls(base=base, body=log.body_frame, body_in_base=row, sensors=sensors)
        return None if found == cls() else found

    @property
    def mounting(self) -> Transform | None:
        """T_base_body, (4, 4); None where the body moves on the base, or its place there is not known."""
        return None if self.body_in_base is None else pose_of_row(np.array(self.body_in_base))

    def trajectory_of_base(self, trajectory: Trajectory, T_body_base: Trajectory = NO_POSES) -> Trajectory:
        """Return the poses of the base for those of the body.

        Args:
            trajectory: Poses of the body.
            T_body_base: Poses of the base in the body, where they move.
        """
        if self.mounting is not None:
            return carried(trajectory, inverse(self.mounting))
        return carried(trajectory, T_body_base)


class InputLog(Config):
    """A log that was read."""

    path: str
    """Absolute path."""
    kind: str
    fingerprint: str
    choices: tuple[str, ...] = ()
    """Which of its topics and files were used, where that was chosen."""
    notes: tuple[str, ...] = ()
    """Notes: what was left out or assumed when the log was read, and what is suspicious in its frames."""
    images: tuple[str, ...] = ()
    """Names of the images beside a LiDAR, which colour the cloud."""
    robot: RobotFrames | None = None
    """None where the log names no coordinate frame."""


class AppendedLog(InputLog):
    """A later session of the same place."""

    source: SourceConfig
    """Selection of its frames; ``config.json`` holds that of the first log."""
    shift_ns: int
    """Nanoseconds added to its stamps."""
    begins_ns: int
    """Stamp of its first frame, on the run's clock."""
    gyroscope: GyroscopeFit | None = None
    """None where it has no gyroscope that was of use."""


class Input(InputLog):
    """The log that was read, and those that were appended since."""

    appended: tuple[AppendedLog, ...] = ()

    @property
    def robot_of_all(self) -> RobotFrames | None:
        """The robot's frames where base and body are the same in all logs, with the sensors of all."""
        robots = [log.robot or RobotFrames() for log in (self, *self.appended)]
        if self.robot is None or len({(one.base, one.body, one.body_in_base) for one in robots}) > 1:
            return None
        sensors = (one for one in self.robot.sensors if all(one in robot.sensors for robot in robots))
        return self.robot.model_copy(update={"sensors": tuple(sensors)})

    @property
    def title(self) -> str:
        """The logs' names."""
        return " + ".join(Path(log.path).name for log in (self, *self.appended))

    def moved(self, logs: Sequence[Path], *, run: Path) -> "Input":
        """Return the same logs at other paths.

        Raises:
            RunError: There are more or fewer; the message names the run.
        """
        if len(logs) != 1 + len(self.appended):
            raise RunError(
                f"{run}: made from {1 + len(self.appended)} logs, {self.title}; "
                f"{len(logs)} given, want all of them in this order"
            )
        first, *others = (str(log.resolve()) for log in logs)
        appended = tuple(
            log.model_copy(update={"path": path}) for log, path in zip(self.appended, others, strict=True)
        )
        return self.model_copy(update={"path": first, "appended": appended})
