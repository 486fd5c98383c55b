"""Logs of MCAP files and ROS bags."""

from dataclasses import replace
from typing import Any

import numpy as np

from mapper.core.errors import SourceError, listed
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.sources.base import BASES, CameraImages, Log, MountedSensor
from mapper.sources.config import SourceConfig
from mapper.sources.laser_scan import rolling
from mapper.sources.ros.cameras import images_beside
from mapper.sources.ros.frame_tree import BY_TF, is_fixed, is_of_wheels
from mapper.sources.ros.message_index import Series, why_unread
from mapper.sources.ros.messages import READ, frame_of
from mapper.sources.ros.reader import SAME_CLOCK_NS, RecordingReader
from mapper.sources.ros.recorded_frames import log_of_frames, refuse_body_frame
from mapper.sources.ros.sensors_beside import sensors_beside
from mapper.sources.ros.topics import CameraTopics, Choice, StereoTopics, choose
from mapper.sources.wheel_files import usable


def recording_log(reader: RecordingReader, config: SourceConfig) -> Log:
    """Return a recording as a log; no frame is decoded before its time.

    Raises:
        SourceError: Nothing in it can be mapped, a requested topic is missing, images do not
            pair, or the camera is unknown.
        DependencyError: Its clouds are packets, and the library that decodes them is not installed.
    """
    recording = reader.recording
    unread = [
        why_unread(recording, series)
        for series in reader.series.values()
        if series.topic.type in READ and series.topic.name not in reader.firsts
    ]
    problems = [*filter(None, unread), *recording.notes]
    try:
        choice = choose(
            reader.series,
            reader.firsts,
            config.topics,
            frames_of_tf=reader.tree.frames,
            path=recording.path,
        )
    except SourceError as error:
        raise SourceError("; ".join([str(error), *problems])) from None
    main = _main_of(choice.frames)
    if len(main) > 1 and not np.ptp(main.stamps_ns):
        raise SourceError(
            f"{recording.path}: all {len(main)} messages of {main.topic.name} have the same stamp and the "
            "same time of recording: nothing tells when they were measured"
        )
    reader.follow_clock(main)
    choice, clock_notes = _on_clock_of(main, choice)
    log = log_of_frames(reader, choice.frames, config)
    body, is_planar = log.body_frame, log.sensor == "lidar-2d"
    truth, truth_choices, truth_notes = _truth(reader, choice, config, body=body)
    accelerations, imu_notes = reader.accelerations(choice.imu, body=body)
    gyroscope, gyroscope_notes = reader.gyroscope(choice.gyroscope, body=body)
    imu_notes = list(dict.fromkeys([*imu_notes, *gyroscope_notes]))  # of one topic, the same order
    wheels, wheel_notes = reader.wheels(choice.wheels, body=body, config=config.wheels, sensor=log.sensor)
    if choice.wheels is None and is_planar:
        wheels, wheel_notes = reader.wheels_by_tf(body, config=config.wheels, sensor=log.sensor)
    wheels, use_notes = (rolling if is_planar else usable)(wheels)
    gnss, gnss_notes = reader.gnss(choice.gnss, body=body)
    tf_notes = [
        f"tf {link}: its poses are not finite or have no direction; left out" for link in reader.tree.damaged
    ]
    if reader.tree.contradicted:
        told = listed(reader.tree.contradicted)
        tf_notes.append(f"tf contradicts itself; of static frames the last is used, as in tf2: {told}")
    mounting, mounting_choices = _mounting(reader, log, config)
    cameras = [images_beside(reader, camera, body=body) for camera in choice.cameras]
    images = [one for one in cameras if isinstance(one, CameraImages)]
    beside, beside_choices = sensors_beside(reader, choice.beside, log, config)
    return replace(
        log,
        truth=truth,
        accelerations=accelerations,
        gyroscope=gyroscope,
        gnss=gnss,
        images=images,
        beside=beside,
        sensors=_sensors(reader, body, mounting.get("base_frame", body)),
        **mounting,
        wheels=wheels,
        choices=[
            *choice.choices,
            *log.choices,
            *truth_choices,
            *(one.choice if isinstance(one, CameraImages) else one for one in cameras),
            *beside_choices,
            *mounting_choices,
        ],
        notes=[
            *choice.notes,
            *problems,
            *clock_notes,
            *log.notes,
            *tf_notes,
            *truth_notes,
            *wheel_notes,
            *use_notes,
            *imu_notes,
            *gnss_notes,
        ],
    )


def _truth(
    reader: RecordingReader, choice: Choice, config: SourceConfig, *, body: str
) -> tuple[Trajectory | None, list[str], list[str]]:
    """Return the true poses by their topic or by tf, what was or may be chosen, and notes.

    Raises:
        SourceError: The body does not move in the frame of tf that the settings name.
    """
    wanted = config.topics.truth or ""
    if wanted.startswith(BY_TF):
        return *reader.truth_by_tf(wanted.removeprefix(BY_TF), body=body), []
    truth, notes = reader.truth(choice.truth, body=body)
    return truth, _offered_truth(reader, body) if truth is None else [], notes


def _offered_truth(reader: RecordingReader, body: str) -> list[str]:
    """Return that tf has poses of the body, in a sentence, unless they are of wheels or its own joints."""
    frames = reader.tree.moving_above(body)
    base = reader.base_of(body)
    if base in frames:  # a camera that pans on a robot
        frames = frames[frames.index(base) + 1 :]
    frames = [one for one in frames if one.rpartition("/")[2] not in BASES and not is_of_wheels(one)]
    if not frames:
        return []
    return [
        f"tf moves {body} in {', '.join(frames)}: where these are true poses (motion capture), "
        f"source.topics.truth={BY_TF}{frames[0]} compares with them"
    ]


def _mounting(reader: RecordingReader, log: Log, config: SourceConfig) -> tuple[dict[str, Any], list[str]]:
    """Return the fields of a log that say where the body is on the robot, and which frames have a base.

    Raises:
        SourceError: The frame that the settings name is none of the robot's.
    """
    body = log.body_frame
    base = reader.base_of(body)
    if log.sensor == "rgbd" and config.body_frame is not None:  # a LiDAR's body is that frame itself
        base = config.body_frame.lstrip("/")
        refuse_body_frame(reader, base, body)
    if base is None:
        return {}, []
    fields = {"base_frame": base, "base_height_m": reader.height_of(base)}
    if not reader.tree.moves(base, body):
        return {**fields, "T_base_body": reader.tree.find(base, body)}, []
    known, T_body_base = reader.tree_of(base, body).find_each(body, base, log.stamps_ns)
    choices = []
    if not known.all():
        choices.append(
            f"tf moves {body} on {base}, and says where at {known.sum()} of {len(known)} frames: only of "
            "these are the robot's poses written (base.tum)"
        )
    return {**fields, "T_body_base": Trajectory(log.stamps_ns[known], T_body_base)}, choices


def _sensors(reader: RecordingReader, body: str, base: str) -> list[MountedSensor]:
    """Return the frames of messages that stay on the body or on the robot's base by tf."""
    found = []
    told = {frame_of(message) for message in reader.firsts.values()}
    told.update(frame for series in reader.series.values() for frame in series.frames)
    for frame in sorted(one for one in told - {"", body, base} if not is_fixed(one)):
        for parent in dict.fromkeys((body, base)):
            T_parent_sensor = reader.tree.find(parent, frame)
            if T_parent_sensor is not None and not reader.tree.moves(parent, frame):
                found.append(MountedSensor(frame, parent, T_parent_sensor))
                break
    return found


def _on_clock_of(main: Series, choice: Choice) -> tuple[Choice, list[str]]:
    """Return the choice with the stamps of every topic on the clock of one, and notes on those moved."""
    notes: list[str] = []

    def moved(series: Series) -> Series:
        shift_ns = main.clock_ns - series.clock_ns
        spans = [(int(one.stamps_ns.min()), int(one.stamps_ns.max())) for one in (main, series)]
        overlap = spans[0][0] <= spans[1][1] and spans[1][0] <= spans[0][1]
        if abs(shift_ns) <= SAME_CLOCK_NS or overlap:
            return series
        notes.append(
            f"{series.topic.name}: its stamps are on another clock than those of {main.topic.name}: moved by "
            f"{shift_ns / NS_PER_S:.1f} s, as the times of recording say"
        )
        return replace(series, stamps_ns=series.stamps_ns + shift_ns)

    frames = choice.frames
    if isinstance(frames, CameraTopics):
        frames = replace(frames, depth=moved(frames.depth))
    elif isinstance(frames, StereoTopics):
        frames = replace(frames, right=moved(frames.right))
    beside = [
        replace(one, color=moved(one.color), depth=moved(one.depth))
        if isinstance(one, CameraTopics)
        else moved(one)
        for one in choice.beside
    ]
    others = (choice.imu, choice.gyroscope, choice.gnss, choice.truth, choice.wheels)
    imu, gyroscope, gnss, truth, wheels = (one and moved(one) for one in others)
    cameras = [replace(camera, images=moved(camera.images)) for camera in choice.cameras]
    followed = replace(
        choice,
        frames=frames,
        imu=imu,
        gyroscope=gyroscope,
        gnss=gnss,
        truth=truth,
        wheels=wheels,
        cameras=cameras,
        beside=beside,
    )
    return followed, list(dict.fromkeys(notes))


def _main_of(frames: CameraTopics | StereoTopics | Series) -> Series:
    """Return the topic whose stamps are the frames'."""
    match frames:
        case CameraTopics():
            return frames.color
        case StereoTopics():
            return frames.left
        case _:
            return frames
