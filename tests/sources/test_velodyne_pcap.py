"""Captures of a Velodyne's packets become scans, a turn each."""

import os
import struct
import sys

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import SourceError
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline.build import build
from mapper.sources import open_source
from mapper.sources.captures import captured
from tests.support.driver_recordings import FIRST_NS, TURN, street, write_datagrams, write_pcap


@pytest.fixture(scope="module")
def simulator():
    return street()


def test_a_capture_is_mapped_a_turn_at_a_time(tmp_path, simulator):
    log, of_pcapng = (
        open_source(write_pcap(tmp_path / name, simulator, packets=round(9.7 * TURN)))
        for name in ("a.pcap", "b.pcapng")
    )
    assert (log.kind, log.sensor) == (of_pcapng.kind, of_pcapng.sensor) == ("velodyne-pcap", "lidar")
    np.testing.assert_allclose(of_pcapng.stamps_ns, log.stamps_ns, atol=1000)  # microseconds are stored
    np.testing.assert_array_equal(of_pcapng[3].points_body, log[3].points_body)
    np.testing.assert_allclose(np.diff(log.stamps_ns[:-1]) / 1e9, 0.1, atol=0.0014)  # the last turn is cut
    scan = log[3]
    np.testing.assert_allclose([scan.times_s.min(), scan.times_s.max()], [-0.0995, 0.0013], atol=0.0014)
    truth = Trajectory(log.stamps_ns, simulator.drive.poses((log.stamps_ns - FIRST_NS) / 1e9))
    run = build(log, load_config(None, sensor="lidar"), tmp_path / "run")
    assert run.manifest.counts.tracked == len(log) == 10
    assert evaluate(run.trajectory, truth).ate_m < 0.03


def test_turns_that_are_cut_and_a_damaged_end_are_left_out(tmp_path, simulator):
    path = write_pcap(tmp_path / "a.pcap", simulator, packets=round(3.2 * TURN))
    data = path.read_bytes()
    log = open_source(path)
    assert len(log) == 3
    assert any("1 of 4 turns are cut" in note for note in log.notes)
    path.write_bytes(data[: int(0.7 * len(data))])
    assert len(open_source(path)) == 2
    path.write_bytes(data)
    os.truncate(path, 1 << 40)  # a hole behind it
    assert len(open_source(path)) == 3


def test_a_packet_of_a_size_that_none_captures_ends_the_capture(tmp_path):
    path = write_datagrams(tmp_path / "a.pcap", [bytes(100)] * 5, port=7502)
    places = [place for place, _ in captured(path)]
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, places[3] + 8, 1 << 19)
    path.write_bytes(data)
    os.truncate(path, 1 << 40)
    assert [place for place, _ in captured(path)] == places[:3]


@pytest.mark.parametrize("data", [b"", b"x" * 100, bytes(24)])
def test_what_is_no_capture_is_refused(tmp_path, data):
    path = tmp_path / "a.pcap"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"a\.pcap: no "):
        open_source(path)


def test_a_capture_without_packets_of_a_velodyne_is_refused(tmp_path, simulator):
    path = write_pcap(tmp_path / "a.pcap", simulator, packets=0)
    with pytest.raises(SourceError, match="no packets of a Velodyne"):
        open_source(path)


@pytest.mark.parametrize(
    ("begins", "size", "port", "maker"),
    [("eeff0601", 1080, 2368, "Hesai"), ("55aa050a", 1248, 6699, "RoboSense"), ("0102", 900, 3000, "")],
)
def test_packets_of_another_maker_are_refused_by_what_they_are(
    tmp_path, monkeypatch, begins, size, port, maker
):
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)  # not to be installed for this
    payload = bytes.fromhex(begins).ljust(size, b"\0")
    path = write_datagrams(tmp_path / "a.pcap", [payload] * 40, port=port)
    with pytest.raises(SourceError, match=rf"{maker}.*{size} bytes to port {port}.*PointCloud2"):
        open_source(path)
