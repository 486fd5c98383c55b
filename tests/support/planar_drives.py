"""Drives of a robot with a 2D laser through floor plans, and recordings of them.

The recordings follow the formats' own descriptions and not our readers: the header that CARMEN's logger
writes into its files, and sensor_msgs/LaserScan, nav_msgs/Odometry and tf2_msgs/TFMessage by rosbags.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mapper.core.geometry import rotation_exp, transform
from mapper.sources.ros.encode_ros import SerializedMessage, odometry_message
from mapper.sources.ros.typestore import make_header, make_message, serialize
from tests.support.recordings import transforms, write

FIRST_NS = 1_700_000_000_000_000_000
Segments = np.ndarray
"""(S, 4) x y of both ends of each wall, metres."""


@dataclass(frozen=True)
class Laser:
    """A 2D laser: beams over an angle, range, and how it turns."""

    beams: int = 360
    fov_rad: float = 2.0 * np.pi
    max_m: float = 12.0
    rate_hz: float = 10.0
    sigma_m: float = 0.01
    sweep_share: float = 0.0
    x_m: float = 0.1
    z_m: float = 0.22

    @property
    def step_rad(self) -> float:
        return self.fov_rad / self.beams

    @property
    def angles_rad(self) -> np.ndarray:
        return -0.5 * self.fov_rad + self.step_rad * np.arange(self.beams)

    @property
    def beam_s(self) -> float:
        return self.sweep_share / self.rate_hz / self.beams


SICK = Laser(beams=180, fov_rad=np.pi, max_m=80.0, rate_hz=5.0)
RPLIDAR = Laser(beams=360, rate_hz=8.0, sweep_share=1.0)


@dataclass(frozen=True)
class Drive:
    """What was driven and measured: times in seconds, poses as x, y and yaw of the robot's base."""

    laser: Laser
    times_s: np.ndarray
    truth: np.ndarray
    readings_s: np.ndarray
    readings: np.ndarray
    ranges_m: np.ndarray

    @property
    def wheels(self) -> np.ndarray:
        """(N, 3) poses by the wheels at the scans' times."""
        return _at(self.readings, self.times_s, self.readings_s[1])

    def part(self, scans: int) -> "Drive":
        """The first scans of the drive."""
        read = self.readings_s <= self.times_s[scans]
        return replace(
            self,
            times_s=self.times_s[:scans],
            truth=self.truth[:scans],
            readings_s=self.readings_s[read],
            readings=self.readings[read],
            ranges_m=self.ranges_m[:scans],
        )


def room(x: float, y: float, width: float, depth: float, doors: tuple[tuple[str, float], ...] = ()) -> list:
    """Walls of a room from its lower left corner; a door of 1 m is a gap in side n, s, e or w."""
    walls = []
    ends = {"s": (x, y, x + width, y), "n": (x, y + depth, x + width, y + depth)}
    ends |= {"w": (x, y, x, y + depth), "e": (x + width, y, x + width, y + depth)}
    for side, (x0, y0, x1, y1) in ends.items():
        gaps = sorted(at for name, at in doors if name == side)
        length, begin = np.hypot(x1 - x0, y1 - y0), 0.0
        u = np.array([x1 - x0, y1 - y0]) / length
        for at in [*gaps, None]:
            end = length if at is None else at - 0.5
            walls.append([x0 + begin * u[0], y0 + begin * u[1], x0 + end * u[0], y0 + end * u[1]])
            begin = 0.0 if at is None else at + 0.5
    return walls


def box(x: float, y: float, width: float, depth: float, yaw: float) -> list:
    """Outline of a piece of furniture."""
    c, s = np.cos(yaw), np.sin(yaw)
    corners = 0.5 * np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]])
    turned = corners @ np.array([[c, s], [-s, c]]) + [x, y]
    return [[*turned[k], *turned[(k + 1) % 4]] for k in range(4)]


def office(seed: int = 0) -> tuple[Segments, np.ndarray]:
    """A ring of corridors of 2 m around a core, with rooms on both sides; and a way of 1.4 rounds."""
    rng, walls = np.random.default_rng(seed), []
    length, depth, corridor, deep = 34.0, 18.0, 2.0, 4.0  # of the core with its corridor
    for side in ("s", "n"):  # rooms outside, of different widths
        x = -corridor
        while x < length + corridor - 2.0:
            width = min(rng.uniform(2.6, 6.0), length + corridor - x)
            low = -corridor - deep if side == "s" else depth + corridor
            walls += room(
                x, low, width, deep, ((("n" if side == "s" else "s"), rng.uniform(0.8, width - 0.8)),)
            )
            x += width
    for side in ("w", "e"):
        y = -corridor
        while y < depth + corridor - 2.0:
            width = min(rng.uniform(2.6, 5.0), depth + corridor - y)
            low = -corridor - deep if side == "w" else length + corridor
            walls += room(
                low, y, deep, width, ((("e" if side == "w" else "w"), rng.uniform(0.8, width - 0.8)),)
            )
            y += width
    walls += room(0.0, 0.0, length, depth, (("s", 6.3), ("n", 21.0), ("e", 4.4), ("w", 12.2)))
    for _ in range(60):  # furniture in the rooms, and some in the core
        x, y = rng.uniform(-5.6, length + 5.6), rng.uniform(-5.6, depth + 5.6)
        in_corridor = (
            -2.4 < x < length + 2.4
            and -2.4 < y < depth + 2.4
            and not (0.6 < x < length - 0.6 and 0.6 < y < depth - 0.6)
        )
        if not in_corridor:
            walls += box(x, y, rng.uniform(0.4, 1.6), rng.uniform(0.4, 0.9), rng.uniform(0, np.pi))
    for x in (3.0, 17.0, 29.0):  # cupboards in the corridor
        walls += box(x, -0.2, 0.9, 0.4, 0.0)
    ring = [[-1.0, -1.0], [length + 1.0, -1.0], [length + 1.0, depth + 1.0], [-1.0, depth + 1.0]]
    return np.array(walls), np.array([[5.0, -1.0], *ring[1:], *ring[:2], [length + 1.0, 6.0]])


def corridor(length_m: float = 60.0) -> tuple[Segments, np.ndarray]:
    """A bare corridor, longer than a laser reaches, with a room at each end; and a way there and back."""
    walls = room(-6.0, -3.0, 6.0, 6.0, (("e", 2.5), ("e", 3.5))) + room(
        length_m, -3.0, 6.0, 6.0, (("w", 2.5), ("w", 3.5))
    )
    walls += [[0.0, -1.0, length_m, -1.0], [0.0, 1.0, length_m, 1.0]]
    walls += box(-4.0, 1.5, 1.0, 0.6, 0.3) + box(length_m + 3.0, -1.8, 0.8, 1.2, 0.7)
    return np.array(walls), np.array(
        [[-3.0, -0.3], [length_m + 4.0, -0.3], [length_m + 4.0, 1.5], [length_m + 2.0, 0.2], [-3.0, 0.2]]
    )


def hall(seed: int = 1) -> tuple[Segments, np.ndarray]:
    """A hall of 40 m by 25 m with racks and pillars; and a way around and between them."""
    rng = np.random.default_rng(seed)
    walls = room(0.0, 0.0, 40.0, 25.0, (("s", 11.0),))
    for x in (9.0, 17.0, 28.0):
        for y in (7.0, 16.0):
            walls += box(x + rng.uniform(-1, 1), y, rng.uniform(3, 5), 1.2, rng.uniform(-0.1, 0.1))
    for x, y in rng.uniform([2.0, 10.5], [38.0, 12.5], (6, 2)):
        walls += box(x, y, 0.5, 0.5, 0.0)
    way = [
        [4.0, 3.5],
        [35.0, 3.5],
        [35.0, 20.5],
        [4.0, 20.5],
        [4.0, 3.5],
        [22.0, 3.5],
        [23.0, 20.0],
        [12.0, 20.5],
    ]
    return np.array(walls), np.array(way)


def drive(
    plan: tuple[Segments, np.ndarray],
    laser: Laser,
    *,
    speed_mps: float = 0.8,
    slip: float = 0.05,
    seed: int = 0,
) -> Drive:
    """Drive a way at a constant speed, on arcs of 0.5 m, with wheels that slip in distance and turn."""
    walls, way = plan
    rng = np.random.default_rng(seed)
    fine_s = 1.0 / 200.0
    fine = _path(way, speed_mps * fine_s)
    span_s = (len(fine) - 1) * fine_s
    times_s = np.arange(0.0, span_s - 1.5 / laser.rate_hz, 1.0 / laser.rate_hz)
    ranges_m = np.array([_scan(walls, laser, fine, time_s, fine_s, rng) for time_s in times_s])
    truth = _at(fine, times_s, fine_s)
    readings_s = np.arange(0.0, span_s, 0.025)
    readings = _wheels(_at(fine, readings_s, fine_s), slip, rng)
    return Drive(laser, times_s, truth, readings_s, readings, ranges_m)


def _path(way: np.ndarray, step_m: float, radius_m: float = 0.5) -> np.ndarray:
    """(N, 3) poses along a way with rounded corners; the yaw is continuous."""
    pieces, begin = [], way[0]
    yaw = np.arctan2(*(way[1] - way[0])[::-1])
    for k in range(1, len(way)):
        along = way[k] - begin
        length = np.linalg.norm(along)
        last = k == len(way) - 1
        turn = 0.0
        if not last:
            onward = np.arctan2(*(way[k + 1] - way[k])[::-1])
            turn = (onward - yaw + np.pi) % (2.0 * np.pi) - np.pi
        cut = 0.0 if last else min(radius_m * np.tan(min(abs(turn), 2.0) / 2.0), 0.45 * length)
        straight = np.arange(0.0, length - cut, step_m)
        u = np.array([np.cos(yaw), np.sin(yaw)])
        pieces.append(np.column_stack([begin + straight[:, None] * u, np.full(len(straight), yaw)]))
        if last:
            break
        corner = way[k] - cut * u
        yaws = yaw + turn * np.linspace(0.0, 1.0, max(2, int(abs(turn) * radius_m / step_m)))
        exit_ = way[k] + cut * np.array([np.cos(onward), np.sin(onward)])
        blend = np.linspace(0.0, 1.0, len(yaws))[:, None]
        curve = (1 - blend) ** 2 * corner + 2 * blend * (1 - blend) * way[k] + blend**2 * exit_
        pieces.append(np.column_stack([curve, yaws]))
        begin, yaw = exit_, yaw + turn
    return _smooth(np.vstack(pieces))


def _smooth(path: np.ndarray, samples: int = 80) -> np.ndarray:
    """A path without sudden turns: means over 0.4 s."""
    padded = np.pad(path, ((samples // 2, samples - samples // 2 - 1), (0, 0)), mode="edge")
    kernel = np.full(samples, 1.0 / samples)
    return np.column_stack([np.convolve(column, kernel, "valid") for column in padded.T])


def _at(fine: np.ndarray, times_s: np.ndarray, fine_s: float) -> np.ndarray:
    knots = np.arange(len(fine)) * fine_s
    return np.column_stack([np.interp(times_s, knots, fine[:, k]) for k in range(3)])


def _scan(walls, laser, fine, time_s, fine_s, rng) -> np.ndarray:
    base = _at(fine, time_s + laser.beam_s * np.arange(laser.beams), fine_s)
    angles = base[:, 2] + laser.angles_rad
    origin = base[:, :2] + laser.x_m * np.column_stack([np.cos(base[:, 2]), np.sin(base[:, 2])])
    direction = np.column_stack([np.cos(angles), np.sin(angles)])
    along = walls[:, 2:] - walls[:, :2]
    to_wall = walls[None, :, :2] - origin[:, None]
    cross = direction[:, None, 0] * along[None, :, 1] - direction[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = (to_wall[..., 0] * along[None, :, 1] - to_wall[..., 1] * along[None, :, 0]) / cross
        share = (to_wall[..., 0] * direction[:, None, 1] - to_wall[..., 1] * direction[:, None, 0]) / cross
    hit = (range_m > 0.0) & (share >= 0.0) & (share <= 1.0)
    nearest = np.where(hit, range_m, np.inf).min(axis=1)
    noisy = nearest + rng.normal(0.0, laser.sigma_m, laser.beams)
    return np.where(nearest < laser.max_m, noisy, np.inf)


def _wheels(truth: np.ndarray, slip: float, rng: np.random.Generator) -> np.ndarray:
    """Dead reckoning: distances too long and turns too small by the slip, and noisy by half of it."""
    poses = [np.zeros(3)]
    for before, after in pairwise(truth):
        step, yaw = after - before, before[2]
        forward = np.cos(yaw) * step[0] + np.sin(yaw) * step[1]
        side = -np.sin(yaw) * step[0] + np.cos(yaw) * step[1]
        forward *= 1.0 + slip + 0.5 * slip * rng.normal()
        turn = step[2] * (1.0 - slip) + 0.1 * slip * abs(forward) * rng.normal()
        x, y, heading = poses[-1]
        c, s = np.cos(heading), np.sin(heading)
        poses.append(np.array([x + c * forward - s * side, y + s * forward + c * side, heading + turn]))
    return np.array(poses)


def write_carmen(path: Path, drive: Drive, *, message: str = "FLASER", is_relative: bool = False) -> Path:
    """Write CARMEN's lines: FLASER or ROBOTLASER1, with ODOM before each; no return is written as 81.91."""
    laser = drive.laser
    lines = [
        "# CARMEN Logfile",
        "# file format is one message per line",
        "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp",
        f"PARAM robot_frontlaser_offset {laser.x_m:.6f} nohost 0.0",
    ]
    for time_s, (x, y, yaw), ranges in zip(drive.times_s, drive.wheels, drive.ranges_m, strict=True):
        stamp = time_s if is_relative else FIRST_NS / 1e9 + time_s
        measured = np.where(np.isfinite(ranges), ranges, 81.91)
        words = " ".join(f"{r:.2f}" for r in measured)
        at_laser = (x + laser.x_m * np.cos(yaw), y + laser.x_m * np.sin(yaw), yaw)
        end = f"{stamp:.6f} nohost {time_s:.6f}"
        lines.append(f"ODOM {x:.6f} {y:.6f} {yaw:.6f} 0.8 0.0 0.0 {end}")
        pose, odom = (" ".join(f"{v:.6f}" for v in numbers) for numbers in (at_laser, (x, y, yaw)))
        if message == "FLASER":
            lines.append(f"FLASER {laser.beams} {words} {pose} {odom} {end}")
        else:
            beams = f"{laser.angles_rad[0]:.6f} {laser.fov_rad:.6f} {laser.step_rad:.8f}"
            head = f"0 {beams} {laser.max_m:.2f} 0.01 0"
            tail = f"0 {pose} {odom} 0.8 0.0 0.0 0.0 0.0 {end}"
            lines.append(f"{message} {head} {laser.beams} {words} {tail}")
    path.write_text("\n".join(lines) + "\n")
    return path


def write_ros(
    path: Path,
    drive: Drive,
    *,
    odometry: str = "topic",
    yaw_mount: float = 0.0,
    pitch_mount: float = 0.0,
    tied: str = "laser",
) -> Path:
    """Write /scan, and /odom as a topic or as the transform odom → base_link, into a bag or a folder."""
    laser = drive.laser
    mounting = transform(rotation_exp(np.array([0.0, pitch_mount, yaw_mount])), [laser.x_m, 0.0, laser.z_m])
    messages = [transforms(("base_link", tied, mounting), stamp_ns=FIRST_NS)]
    for time_s, (x, y, yaw) in zip(drive.readings_s, drive.readings, strict=True):
        stamp_ns = FIRST_NS + round(1e9 * time_s)
        T_odom_base = transform(rotation_exp(np.array([0.0, 0.0, yaw])), [x, y, 0.0])
        if odometry == "tf":
            message = transforms(("odom", "base_link", T_odom_base), topic="/tf", stamp_ns=stamp_ns)
        else:
            message = odometry_message(stamp_ns, "/odom", T_odom_base, frame="odom", child="base_link")
        messages.append(message)
    type_ = "sensor_msgs/msg/LaserScan"
    for time_s, ranges in zip(drive.times_s, drive.ranges_m, strict=True):
        stamp_ns = FIRST_NS + round(1e9 * time_s)
        scan = make_message(
            type_,
            header=make_header(stamp_ns, "laser"),
            angle_min=float(laser.angles_rad[0]) - yaw_mount,
            angle_max=float(laser.angles_rad[-1]) - yaw_mount,
            angle_increment=laser.step_rad,
            time_increment=laser.beam_s,
            scan_time=1.0 / laser.rate_hz,
            range_min=0.05,
            range_max=laser.max_m,
            ranges=ranges.astype(np.float32),
            intensities=np.full(laser.beams, 100.0, np.float32),
        )
        messages.append(SerializedMessage(stamp_ns, "/scan", type_, serialize(scan)))
    return write(path, sorted(messages, key=lambda message: message.stamp_ns))


def flat(seed: int = 3) -> tuple[Segments, np.ndarray]:
    """Two rooms with furniture; and a way of 40 m, twice around and through the door."""
    rng = np.random.default_rng(seed)
    walls = room(0.0, 0.0, 7.0, 6.0, (("e", 2.0),)) + room(7.2, 0.0, 6.0, 6.0, (("w", 2.0),))
    for x, y in ((3.4, 3.2), (10.2, 3.4), (0.6, 5.4), (12.6, 0.6), (6.2, 5.3), (8.0, 5.5)):
        walls += box(x, y, rng.uniform(0.5, 1.2), rng.uniform(0.4, 0.8), rng.uniform(0.0, np.pi))
    ring = [[1.5, 1.2], [5.5, 2.0], [9.0, 2.0], [11.8, 1.6], [11.8, 4.8], [8.6, 4.6], [8.6, 2.0], [5.5, 2.0]]
    return np.array(walls), np.array([*ring, [5.3, 4.6], [1.5, 4.6], *ring[:4]])
