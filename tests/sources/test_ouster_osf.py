"""Ouster's recordings of scans (.osf), in the encodings of its SDK, become the scans that they mean."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import DataError, SourceError
from mapper.sources import open_source
from mapper.sources.flatbuffer import Table
from tests.support.ouster_osf import metadata, scan_message, write_osf
from tests.support.ouster_packets import FIRST_NS, SCAN_NS, Ouster, check_scan, drawn

SENSOR = Ouster()


def stamped(sensor, scans, **options):
    """Return the messages of scans, each stamped when it began."""
    stamps_ns = [FIRST_NS + i * SCAN_NS for i in range(len(scans))]
    return [
        (ns, scan_message(sensor, one, stamp_ns=ns, **options))
        for ns, one in zip(stamps_ns, scans, strict=True)
    ]


@pytest.fixture
def recorded(tmp_path):
    scans = [drawn(SENSOR, seed) for seed in range(6)]
    return write_osf(tmp_path / "a.osf", [stamped(SENSOR, scans)], [metadata(SENSOR)])


@pytest.mark.parametrize("encoding", ["zpng", "png"])
@pytest.mark.parametrize("profile", ["LEGACY", "RNG15_RFL8_NIR8", "RNG19_RFL8_SIG16_NIR16_DUAL"])
def test_points_times_and_reflectivities_are_those_of_every_encoding(tmp_path, encoding, profile):
    sensor = replace(SENSOR, profile=profile)
    scans = [drawn(sensor, seed) for seed in range(3)]
    messages = stamped(sensor, scans, encoding=encoding, invalid=range(20, 30))
    log = open_source(write_osf(tmp_path / "a.osf", [messages], [metadata(sensor)]))
    assert (log.kind, log.body_frame, len(log)) == ("ouster-osf", "os_sensor", 3)
    for i, (scan, ranges_mm) in enumerate(zip(log, scans, strict=True)):
        check_scan(scan, sensor, ranges_mm, FIRST_NS + i * SCAN_NS, invalid=range(20, 30))


def test_inertial_readings_of_the_scans_are_read_with_their_place(tmp_path):
    rng = np.random.default_rng(3)
    readings = []
    for i in range(3):
        stamps_ns = FIRST_NS + i * SCAN_NS + np.arange(10) * 10_000_000
        readings.append(
            (stamps_ns, rng.normal(0.0, 0.5, (10, 3)), rng.normal([0.0, 0.0, 9.81], 0.1, (10, 3)))
        )
    messages = [
        (
            FIRST_NS + i * SCAN_NS,
            scan_message(SENSOR, drawn(SENSOR, i), stamp_ns=FIRST_NS + i * SCAN_NS, imu=one),
        )
        for i, one in enumerate(readings)
    ]
    log = open_source(write_osf(tmp_path / "a.osf", [messages], [metadata(SENSOR)]))
    stamps_ns, rates, felt = (np.concatenate([one[k][:9] for one in readings]) for k in range(3))
    R, place_mm = SENSOR.T_sensor_imu_mm[:3, :3], SENSOR.T_sensor_imu_mm[:3, 3]
    np.testing.assert_array_equal(log.gyroscope.stamps_ns, stamps_ns)
    np.testing.assert_allclose(log.gyroscope.rates_radps, rates, atol=1e-6)
    np.testing.assert_allclose(log.accelerations.acceleration_mps2, felt @ R.T, atol=1e-5)
    np.testing.assert_allclose(log.accelerations.place_body, place_mm / 1000.0, atol=1e-9)


def test_two_sensors_are_tied_by_the_poses_that_the_sdk_was_told(tmp_path):
    T = np.eye(4)
    T[:3] = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 0.5]]
    scans = [[drawn(SENSOR, 10 * k + i) for i in range(3)] for k in range(2)]
    texts = [metadata(SENSOR), metadata(SENSOR, T)]
    path = write_osf(tmp_path / "a.osf", [stamped(SENSOR, one) for one in scans], texts)
    log = open_source(path)
    check_scan(log[1], SENSOR, scans[0][1], FIRST_NS + SCAN_NS)
    (beside,) = log.beside
    np.testing.assert_allclose(beside.T_body_sensor, T, atol=1e-9)
    check_scan(beside.log[0], SENSOR, scans[1][0], FIRST_NS)


def test_cut_scans_are_left_out_and_missing_columns_counted(tmp_path):
    few = [*range(100), *range(150, 256)]
    messages = stamped(SENSOR, [drawn(SENSOR, seed) for seed in range(6)])
    messages[0] = FIRST_NS, scan_message(SENSOR, drawn(SENSOR, 0), invalid=few)
    stamp_ns = FIRST_NS + 2 * SCAN_NS
    messages[2] = stamp_ns, scan_message(SENSOR, drawn(SENSOR, 2), stamp_ns=stamp_ns, invalid=range(16))
    log = open_source(write_osf(tmp_path / "a.osf", [messages], [metadata(SENSOR)]))
    assert len(log) == 5
    assert any("1 of 6 scans are cut" in note for note in log.notes)
    assert any("16 of 1280 columns are missing" in note for note in log.notes)


def test_a_damaged_chunk_costs_its_scans(recorded):
    data = bytearray(recorded.read_bytes())
    data[2000] ^= 1
    recorded.write_bytes(data)
    log = open_source(recorded)
    assert len(log) == 4
    assert any("1 of 3 chunks are damaged" in note for note in log.notes)


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.01, 0.5, 0.99])
def test_a_file_that_was_cut_is_refused_in_a_line(recorded, share):
    data = recorded.read_bytes()
    recorded.write_bytes(data[: int(share * len(data))])
    with pytest.raises(SourceError, match=r"a\.osf: no recording of an Ouster, or damaged: ") as refused:
        open_source(recorded)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("encoding", ["qoi", "jpeg", ""])
def test_an_unknown_encoding_is_refused_by_its_bytes(tmp_path, encoding):
    messages = stamped(SENSOR, [drawn(SENSOR, 0)] * 3, encoding=encoding)
    path = write_osf(tmp_path / "a.osf", [messages], [metadata(SENSOR)])
    with pytest.raises(SourceError, match=f"encoding is not known.*{encoding.encode()[:4].hex()}"):
        open_source(path)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("{}", "beam_altitude_angles"),
        (metadata(SENSOR).replace("RNG19_RFL8_SIG16_NIR16", "RNG99"), "RNG99 is not read"),
        (metadata(SENSOR).replace('"columns_per_frame": 256', '"columns_per_frame": 128'), "nothing to map"),
    ],
)
def test_metadata_that_do_not_fit_are_refused_in_a_line(tmp_path, text, cause):
    path = write_osf(tmp_path / "a.osf", [stamped(SENSOR, [drawn(SENSOR, 0)] * 2)], [text])
    with pytest.raises(SourceError, match=cause) as refused:
        open_source(path)
    assert "\n" not in str(refused.value)


def test_a_chunk_that_is_named_many_times_is_read_once(tmp_path):
    messages = stamped(SENSOR, [drawn(SENSOR, seed) for seed in range(2)])
    path = write_osf(tmp_path / "a.osf", [messages], [metadata(SENSOR)], times_named=1000)
    assert len(open_source(path)) == 2


@pytest.mark.parametrize("seed", range(20))
def test_tables_of_any_bytes_are_read_or_refused(seed):
    rng = np.random.default_rng(seed)
    data = bytearray(scan_message(SENSOR, drawn(SENSOR, 0)))
    for at in rng.integers(0, 400, 40):
        data[at] = rng.integers(256)
    for read in (Table.number, Table.array, Table.bytes, Table.tables, Table.text):
        for field in range(9):
            try:
                extra = {Table.number: ["Q"], Table.array: ["<u8"]}.get(read, [])
                read(Table.of_buffer(memoryview(data)), field, *extra)
            except DataError:
                pass
