"""An Ouster's packets, recorded by its driver or captured, become the scans and readings that they mean."""

from dataclasses import replace

import dpkt
import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import SourceError
from mapper.core.frames import Scan
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline.build import build
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.inspection import inspect_log
from mapper.sources.ouster_packets import OusterSensor
from mapper.sources.ros.encode_ros import cloud_message
from tests.support.driver_recordings import DriverRecording, street
from tests.support.ouster_packets import (
    FIRST_NS,
    PIXELS,
    SCAN_NS,
    Ouster,
    check_scan,
    drawn,
    imu_packet,
    nmea_packet,
    simulated,
    write_capture,
    write_recording,
)

SENSOR = Ouster()


def recorded(sensor, scans, **options):
    """Return the packets of scans, each received when the last of its columns was measured."""
    found = []
    for turn, ranges_mm in enumerate(scans):
        packets = sensor.packets(ranges_mm, stamp_ns=FIRST_NS + turn * SCAN_NS, turn=turn + 7, **options)
        step_ns = SCAN_NS // len(packets)
        found += [(FIRST_NS + turn * SCAN_NS + (i + 1) * step_ns, packet) for i, packet in enumerate(packets)]
    return found


def writers():
    return {
        "bag": lambda folder, *packets, **options: write_recording(folder / "a.bag", *packets, **options),
        "rosbag2": lambda folder, *packets, **options: write_recording(folder / "a", *packets, **options),
        "pcap": lambda folder, *packets, **options: write_capture(folder / "a.pcap", *packets, **options),
        "pcapng": lambda folder, *packets, **options: write_capture(folder / "a.pcapng", *packets, **options),
    }


@pytest.fixture(params=writers())
def write(request):
    return writers()[request.param]


@pytest.mark.parametrize("profile", PIXELS)
@pytest.mark.parametrize("flat", [True, False])
def test_points_times_and_reflectivities_are_those_of_every_profile(tmp_path, profile, flat):
    sensor = replace(SENSOR, profile=profile)
    scans = [drawn(sensor, seed) for seed in range(3)]
    metadata = sensor.metadata(flat=flat)
    log = open_source(write_recording(tmp_path / "a.bag", recorded(sensor, scans), metadata=metadata))
    assert (log.sensor, len(log), log.body_frame) == ("lidar", 3, "os_sensor")
    for turn, (scan, ranges_mm) in enumerate(zip(log, scans, strict=True)):
        check_scan(scan, sensor, ranges_mm, FIRST_NS + turn * SCAN_NS)


def test_every_container_has_the_same_scans(tmp_path, write):
    scans = [drawn(SENSOR, seed) for seed in range(3)]
    log = open_source(write(tmp_path, recorded(SENSOR, scans), metadata=SENSOR.metadata()))
    for turn, (scan, ranges_mm) in enumerate(zip(log, scans, strict=True)):
        check_scan(scan, SENSOR, ranges_mm, FIRST_NS + turn * SCAN_NS)


@pytest.mark.parametrize("package", ["ouster_ros", "ouster_sensor_msgs", "ouster_msgs"])
def test_every_driver_is_read(tmp_path, package):
    packets = recorded(SENSOR, [drawn(SENSOR, 0)] * 2)
    path = write_recording(tmp_path / "a", packets, metadata=SENSOR.metadata(), package=package)
    assert len(open_source(path)) == 2


def test_invalid_columns_and_lost_packets_are_missing_and_counted(tmp_path, write):
    scans = [drawn(SENSOR, seed, holes=0.0) for seed in range(3)]
    packets = recorded(SENSOR, scans, invalid=range(20, 30))
    lost = packets[16 + 5]
    log = open_source(write(tmp_path, [one for one in packets if one != lost], metadata=SENSOR.metadata()))
    check_scan(log[0], SENSOR, scans[0], FIRST_NS, invalid=range(20, 30))
    check_scan(log[1], SENSOR, scans[1], FIRST_NS + SCAN_NS, invalid=[*range(20, 30), *range(80, 96)])
    assert any("1 of 48 packets are missing" in note for note in log.notes)


def test_a_window_of_columns_is_a_scan(tmp_path):
    packets = [
        p
        for i, p in enumerate(recorded(SENSOR, [drawn(SENSOR, seed) for seed in range(4)]))
        if 4 <= i % 16 < 9
    ]
    log = open_source(write_recording(tmp_path / "a", packets, metadata=SENSOR.metadata()))
    ranges_mm = drawn(SENSOR, 2)
    outside = [*range(64), *range(144, 256)]
    assert len(log) == 4
    check_scan(log[2], SENSOR, ranges_mm, FIRST_NS + 2 * SCAN_NS, invalid=outside)
    assert log[2].stamp_ns == FIRST_NS + 2 * SCAN_NS + 64 * SCAN_NS // 256


def test_packets_that_came_late_belong_to_their_own_turn(tmp_path):
    packets = [packet for _, packet in recorded(SENSOR, [drawn(SENSOR, seed) for seed in range(3)])]
    packets[14:18] = packets[16], packets[14], packets[17], packets[15]
    stamped = [(FIRST_NS + (i + 1) * SCAN_NS // 16, packet) for i, packet in enumerate(packets)]
    log = open_source(write_recording(tmp_path / "a", stamped, metadata=SENSOR.metadata()))
    assert [len(scan.points_body) for scan in log] == [(drawn(SENSOR, seed) > 0).sum() for seed in range(3)]


def test_a_count_of_turns_that_begins_anew_is_followed(tmp_path):
    scans = [drawn(SENSOR, seed) for seed in range(6)]
    packets = []
    for i, turn in enumerate((65_534, 65_535, 0, 1, 0, 1)):  # it overflows, then the sensor restarts
        stamp_ns = FIRST_NS + i * SCAN_NS
        packets += [
            (stamp_ns, one) for one in SENSOR.packets(scans[i], stamp_ns=stamp_ns, turn=turn + 40 * (i > 3))
        ]
    log = open_source(write_recording(tmp_path / "a", packets, metadata=SENSOR.metadata()))
    for i, (scan, ranges_mm) in enumerate(zip(log, scans, strict=True)):
        check_scan(scan, SENSOR, ranges_mm, FIRST_NS + i * SCAN_NS)


def test_cut_scans_at_the_ends_are_left_out(tmp_path):
    packets = recorded(SENSOR, [drawn(SENSOR, seed) for seed in range(4)])[12:-14]
    log = open_source(write_recording(tmp_path / "a", packets, metadata=SENSOR.metadata()))
    assert len(log) == 2
    assert any("2 of 4 scans are cut" in note for note in log.notes)


@pytest.mark.parametrize("profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16_DUAL"])
def test_damaged_packets_cost_themselves(tmp_path, write, profile):
    sensor = replace(SENSOR, profile=profile)
    packets = recorded(sensor, [drawn(sensor, seed) for seed in range(4)])
    packets[3] = packets[3][0], packets[3][1][:-7]
    packets[20] = packets[20][0], packets[20][1] + bytes(100)
    packets[40] = packets[40][0], b"\xff" * len(packets[40][1])
    log = open_source(write(tmp_path, packets, metadata=sensor.metadata()))
    assert len(log) == 4
    assert any("3 of 64 packets are damaged" in note for note in log.notes)
    check_scan(log[0], sensor, drawn(sensor, 0), FIRST_NS, invalid=range(48, 64))
    check_scan(log[3], sensor, drawn(sensor, 3), FIRST_NS + 3 * SCAN_NS)


def readings(count):
    rng = np.random.default_rng(5)
    felt = rng.normal([0.0, 0.0, 9.81], 0.1, (count, 3))
    return FIRST_NS + np.arange(count) * 10_000_000, rng.normal(0.0, 0.5, (count, 3)), felt


def test_inertial_readings_have_their_own_times_units_and_place(tmp_path, write):
    stamps_ns, rates, felt = readings(30)
    imu = [
        (ns + 200_000, imu_packet(ns, *one)) for ns, *one in zip(stamps_ns.tolist(), rates, felt, strict=True)
    ]
    packets = recorded(SENSOR, [drawn(SENSOR, seed) for seed in range(3)])
    log = open_source(write(tmp_path, packets, imu, metadata=SENSOR.metadata()))
    R, place_mm = SENSOR.T_sensor_imu_mm[:3, :3], SENSOR.T_sensor_imu_mm[:3, 3]
    np.testing.assert_array_equal(log.gyroscope.stamps_ns, stamps_ns)
    np.testing.assert_allclose(log.gyroscope.rates_radps, rates, atol=1e-6)
    np.testing.assert_allclose(log.gyroscope.R_body_imu, R, atol=1e-9)
    np.testing.assert_allclose(log.accelerations.acceleration_mps2, felt @ R.T, atol=1e-5)
    np.testing.assert_allclose(log.accelerations.place_body, place_mm / 1000.0, atol=1e-9)


def test_several_readings_in_a_packet_are_read(tmp_path):
    stamps_ns, rates, felt = readings(32)
    imu = [
        (stamps_ns[i + 7], nmea_packet(*(one[i : i + 8] for one in (stamps_ns, rates, felt))))
        for i in range(0, 32, 8)
    ]
    packets = recorded(SENSOR, [drawn(SENSOR, seed) for seed in range(3)])
    log = open_source(write_recording(tmp_path / "a.bag", packets, imu, metadata=SENSOR.metadata()))
    valid = np.arange(32) % 8 < 7
    np.testing.assert_array_equal(log.gyroscope.stamps_ns, stamps_ns[valid])
    np.testing.assert_allclose(log.gyroscope.rates_radps, rates[valid], atol=1e-6)


def test_metadata_may_be_in_a_file_beside_a_recording(tmp_path):
    path = write_recording(tmp_path / "a.bag", recorded(SENSOR, [drawn(SENSOR, 0)] * 2))
    (tmp_path / "b.json").write_text(replace(SENSOR, serial=1).metadata())
    (tmp_path / "notes.json").write_text("{}")
    (tmp_path / "a_0.json").write_text(SENSOR.metadata())
    assert len(open_source(path)) == 2


@pytest.mark.parametrize(
    ("metadata", "cause"),
    [
        (None, "but not the metadata"),
        (replace(SENSOR, serial=5).metadata(), "a.json is of sensor 5"),
        (replace(SENSOR, profile="LEGACY").metadata(), "bytes a packet"),
        (SENSOR.metadata().replace("RNG19_RFL8_SIG16_NIR16", "RNG99"), "RNG99 is not read"),
        (SENSOR.metadata()[:900], "a.json: Invalid JSON"),
        (SENSOR.metadata().replace("3.1, 1.0", "3.1", 1), "16 altitude angles, 15 azimuth angles"),
        (SENSOR.metadata().replace("15.0,", "NaN,", 1), "beam_altitude_angles"),
    ],
)
def test_packets_without_fitting_metadata_are_refused_in_a_line(tmp_path, metadata, cause):
    path = write_capture(tmp_path / "a.pcap", recorded(SENSOR, [drawn(SENSOR, 0)] * 2), metadata=metadata)
    with pytest.raises(SourceError, match=r"a\.pcap: .*beside the log as a\.json") as refused:
        open_source(path)
    assert cause in str(refused.value)
    assert "\n" not in str(refused.value)


def test_inspect_says_that_metadata_are_missing(tmp_path):
    path = write_recording(tmp_path / "a.bag", recorded(SENSOR, [drawn(SENSOR, 0)] * 2))
    with pytest.raises(SourceError, match="record its metadata topic too"):
        inspect_log(path, config=load_config(None).source)


@pytest.mark.parametrize("has_metadata", [True, False])
def test_clouds_are_taken_before_packets_which_are_named(tmp_path, has_metadata):
    points = np.random.default_rng(0).uniform(-9.0, 9.0, (50, 3)).astype(np.float32)
    with DriverRecording(tmp_path / "a", "ouster_ros") as recording:
        if has_metadata:
            text = recording.make("std_msgs/msg/String", data=SENSOR.metadata())
            recording.write(FIRST_NS, "/ouster/metadata", text)
        for received_ns, packet in recorded(SENSOR, [drawn(SENSOR, seed) for seed in range(3)]):
            message = recording.make("PacketMsg", buf=np.frombuffer(packet, np.uint8))
            recording.write(received_ns, "/ouster/lidar_packets", message)
        for turn in range(3):
            scan = Scan(FIRST_NS + turn * SCAN_NS, points)
            recording.add(cloud_message("/ouster/points", scan, frame="os_lidar"))
    log = open_source(tmp_path / "a")
    assert log.body_frame == "os_lidar"
    np.testing.assert_array_equal(log[0].points_body, points)
    assert any("/ouster/lidar_packets" in note for note in log.notes)


def test_the_sensor_of_most_packets_is_mapped_and_another_can_be_chosen(tmp_path):
    ours, theirs = (replace(SENSOR, serial=serial) for serial in (11, 22))
    few, many = recorded(ours, [drawn(ours, 0)] * 2), recorded(theirs, [drawn(theirs, 1)] * 3)
    with (tmp_path / "a.pcap").open("wb") as file:
        writer = dpkt.pcap.Writer(file)
        for name, packets in (("b", few), ("c", many)):
            path = write_capture(tmp_path / f"{name}.pcap", packets)
            for ts, frame in dpkt.pcap.Reader(path.open("rb")):
                address = bytes([192, 168, 1, 201 + (name == "c")])
                writer.writepkt(frame[:26] + address + frame[30:], ts=ts)
    for name, sensor in (("a_0", ours), ("a_1", theirs)):
        (tmp_path / f"{name}.json").write_text(sensor.metadata())
    assert len(open_source(tmp_path / "a.pcap")) == 3
    topics = {"points": "192.168.1.201:7502"}
    chosen = load_config(None, sensor="lidar").source.model_copy(
        update={"topics": load_config(None).source.topics.model_copy(update=topics)}
    )
    log = open_source(tmp_path / "a.pcap", chosen)
    check_scan(log[1], ours, drawn(ours, 0), FIRST_NS + SCAN_NS)


@pytest.mark.parametrize("link", [113, 276, 101])
def test_captures_of_other_links_are_read(tmp_path, link):
    scans = [drawn(SENSOR, seed) for seed in range(2)]
    path = write_capture(tmp_path / "a.pcap", recorded(SENSOR, scans), metadata=SENSOR.metadata())
    frames = list(dpkt.pcap.Reader(path.open("rb")))
    heads = {113: bytes(14) + b"\x08\x00", 276: b"\x08\x00" + bytes(18), 101: b""}
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, linktype=link)
        for ts, frame in frames:
            writer.writepkt(heads[link] + frame[14:], ts=ts)
    check_scan(open_source(path)[1], SENSOR, scans[1], FIRST_NS + SCAN_NS)


def test_a_lost_fragment_costs_its_packet(tmp_path):
    path = write_capture(
        tmp_path / "a.pcap", recorded(SENSOR, [drawn(SENSOR, 0)] * 3), metadata=SENSOR.metadata()
    )
    frames = list(dpkt.pcap.Reader(path.open("rb")))
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file)
        for i, (ts, frame) in enumerate(frames):
            if i != 61:
                writer.writepkt(frame, ts=ts)
    log = open_source(path)
    assert len(log) == 3
    assert any("1 of 48 packets are missing" in note for note in log.notes)


@pytest.mark.parametrize("size", [0, 10, 43, 44, 3000, 3328])
@pytest.mark.parametrize("fill", [0, 255])
def test_scans_of_any_bytes_are_decoded_or_refused(size, fill):
    sensor = OusterSensor(SENSOR.metadata(), where="a.json")
    packet = memoryview(bytes([fill]) * size)
    if size != sensor.packet_bytes:
        with pytest.raises(ValueError, match="reshape"):
            sensor.scan([packet], FIRST_NS)
    else:
        assert len(sensor.scan([packet], FIRST_NS).points_body) == 0


def test_packets_are_mapped_as_the_scans_that_they_are_made_of(tmp_path):
    simulator = street(azimuth_steps=256)
    log = simulator.log()
    rings_deg = np.linspace(-15.0, 15.0, 16).tolist()
    sensor, lidar, imu = simulated(log, rings_deg=rings_deg, columns=256)
    config = load_config(None, sensor="lidar")
    read = open_source(write_recording(tmp_path / "a.bag", lidar, imu, metadata=sensor.metadata()))
    scans, packets = (
        track_log(log, config, progress=SILENT).trajectory(),
        build(read, config, tmp_path / "run"),
    )
    expected_m, ate_m = (evaluate(one, simulator.truth).ate_m for one in (scans, packets.trajectory))
    assert len(read) == len(log)
    np.testing.assert_allclose(ate_m, expected_m, atol=0.003)
