"""GNSS fixes go over with a log into other formats, and come back; inspection tells of them."""

import json
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.geodesy import GeodeticOrigin
from mapper.core.geometry import exp
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S
from mapper.simulation.config import STREET
from mapper.simulation.gnss_config import SynthGnssConfig
from mapper.simulation.lidar import LidarSimulator, write_lidar_log
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, TopicsConfig
from mapper.sources.gnss_files import read_gnss
from mapper.sources.nmea import fixes_from_sentences
from mapper.sources.ros.encode_ros import SerializedMessage, fix_message
from mapper.sources.writers import left_out, write_log
from tests.support.command_line import invoke
from tests.support.recordings import shots, transforms, write

EXACT = SynthGnssConfig(noise_m=0.0, bias_m=0.0, rate_hz=20.0)
SHORT = STREET.model_copy(
    update={
        "duration_s": 0.5,
        "gnss": SynthGnssConfig(rate_hz=20.0),
        "sensor": STREET.sensor.model_copy(update={"rings": 4, "azimuth_steps": 90}),
    }
)


@pytest.fixture(scope="module")
def street():
    return LidarSimulator(SHORT).log()


@pytest.mark.parametrize("name", ["kitti", "log.mcap", "log.bag"])
def test_fixes_come_back(street, tmp_path, name):
    kind = name.removeprefix("log.")
    write_log(street, tmp_path / name, kind=kind)
    again = open_source(tmp_path / name).gnss
    for part in ("stamps_ns", "geodetic", "covariances_enu", "status"):
        np.testing.assert_array_equal(getattr(again, part), getattr(street.gnss, part))
    np.testing.assert_allclose(again.antenna_body, SHORT.gnss.antenna_body, atol=1e-12)
    assert left_out(street, kind) == []
    assert left_out(street, "mbag") == ["mbag has no place for GNSS fixes; left out"]


def test_exact_fixes_are_where_the_antenna_is():
    config = SHORT.model_copy(update={"gnss": EXACT})
    simulator = LidarSimulator(config)
    fixes = simulator.log().gnss
    origin = GeodeticOrigin(EXACT.latitude_deg, EXACT.longitude_deg, EXACT.height_m)
    index = np.searchsorted(fixes.stamps_ns, simulator.truth.stamps_ns)
    T = simulator.truth.T_world_body
    expected = T[:, :3, :3] @ np.array(EXACT.antenna_body) + T[:, :3, 3]
    R_enu_world = rotation_from_euler(0.0, 0.0, EXACT.heading_rad)
    np.testing.assert_allclose(origin.enu(fixes.geodetic[index]), expected @ R_enu_world.T, atol=1e-6)
    far = EXACT.model_copy(
        update={"outage_duration_s": 0.2, "multipath_start_s": 0.3, "multipath_duration_s": 0.1}
    )
    away = LidarSimulator(SHORT.model_copy(update={"gnss": far})).log().gnss
    assert len(fixes) - len(away) == 4
    off_m = np.linalg.norm(origin.enu(away.geodetic) - origin.enu(fixes.geodetic[4:]), axis=1)
    assert off_m[2:4].min() > 15.0 * (1.0 - 1e-6)
    assert np.delete(off_m, [2, 3]).max() < 1e-6


def test_inspection_tells_number_rate_status_and_sigma(tmp_path):
    write_lidar_log(tmp_path / "log", SHORT)
    (row,) = [
        line for line in invoke("inspect", tmp_path / "log").stdout.splitlines() if line.startswith("gnss")
    ]
    assert "11 fixes (11 without augmentation), σ 1.1 m" in row
    facts = json.loads(invoke("inspect", tmp_path / "log", "--json").stdout)["log"]
    assert (facts["gnss"]["count"], facts["gnss"]["rate_hz"]) == (11, 20.0)
    assert facts["gnss_sigma_m"] == pytest.approx(np.hypot(0.5, 1.0))


def test_a_receivers_topic_goes_before_a_filters_and_another_can_be_chosen(tmp_path):
    T_camera_antenna = exp(np.array([0.0, 0.1, 0.0]), np.array([0.2, -0.5, 1.0]))
    messages = [*shots(3), transforms(("optical", "antenna", T_camera_antenna))]
    for topic, status in (("/a/filtered", 0), ("/ublox/fix", 2)):
        for k, shot in enumerate(shots(3)[::3]):
            messages.append(
                fix_message(
                    shot.stamp_ns,
                    topic,
                    geodetic=np.array([47.0, 19.0, 100.0 + k]),
                    covariance_enu=np.eye(3) if k else np.full((3, 3), np.nan),
                    status=status,
                    frame="antenna",
                )
            )
    write(tmp_path / "a.mcap", messages)
    log = open_source(tmp_path / "a.mcap")
    assert log.gnss.name == "/ublox/fix"
    np.testing.assert_allclose(log.gnss.antenna_body, T_camera_antenna[:3, 3])
    assert set(log.gnss.status.tolist()) == {2}
    assert np.isnan(log.gnss.covariances_enu[0]).all()
    np.testing.assert_array_equal(log.gnss.covariances_enu[1], np.eye(3))
    assert any(note.endswith(": /a/filtered") for note in log.notes)
    chosen = open_source(tmp_path / "a.mcap", SourceConfig(topics=TopicsConfig(gnss="/a/filtered")))
    assert chosen.gnss.name == "/a/filtered"


GPS_STATUS = "std_msgs/Header header\n" + "\n".join(
    [
        "uint16 satellites_used\nint32[] satellite_used_prn\nuint16 satellites_visible",
        *(f"int32[] satellite_visible_{name}" for name in ("prn", "z", "azimuth", "snr")),
        "int16 STATUS_DGPS_FIX=18\nint16 status",
        *(f"uint16 {name}_source" for name in ("motion", "orientation", "position")),
    ]
)
NUMBERS = (
    *("latitude", "longitude", "altitude", "track", "speed", "climb", "pitch", "roll", "dip", "time"),
    *("gdop", "pdop", "hdop", "vdop", "tdop", "err", "err_horz", "err_vert", "err_track", "err_speed"),
    *("err_climb", "err_time", "err_pitch", "err_roll", "err_dip"),
)
GPS_FIX = "std_msgs/Header header\nGPSStatus status\n" + "\n".join(
    [
        *(f"float64 {name}" for name in NUMBERS),
        "float64[9] position_covariance\nuint8 COVARIANCE_TYPE_KNOWN=3\nuint8 position_covariance_type",
    ]
)


"""As gps_umd defines them."""


def receivers_store():
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(GPS_STATUS, "gps_msgs/msg/GPSStatus"))
    store.register(get_types_from_msg(GPS_FIX, "gps_msgs/msg/GPSFix"))
    store.register(get_types_from_msg("std_msgs/Header header\nstring sentence", "nmea_msgs/msg/Sentence"))
    return store


def message_of(store, type_, stamp_ns, topic, **fields):
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="antenna")
    message = store.types[type_](header=header, **fields)
    return SerializedMessage(stamp_ns, topic, type_, bytes(store.serialize_cdr(message, type_)))


def test_gps_fixes_are_fixes_with_their_own_numbers_of_status(tmp_path):
    store, none = receivers_store(), np.zeros(0, np.int32)
    messages = [*shots(3)]
    for k, shot in enumerate(shots(3)[::3]):
        status = store.types["gps_msgs/msg/GPSStatus"](
            **{name: none for name in GPS_STATUS.split() if name.startswith("satellite_")},
            header=store.types["std_msgs/msg/Header"](
                stamp=store.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id=""
            ),
            satellites_used=7, satellites_visible=9, status=18,
            motion_source=0, orientation_source=0, position_source=1,
        )  # fmt: skip
        place = dict.fromkeys(NUMBERS, 0.0) | {"latitude": 47.0, "longitude": 19.0, "altitude": 100.0 + k}
        covariance = {"position_covariance": np.eye(3).ravel() * 0.25, "position_covariance_type": 3}
        stamp_ns = shot.stamp_ns
        messages.append(
            message_of(store, "gps_msgs/msg/GPSFix", stamp_ns, "/gps", status=status, **place, **covariance)
        )
    write(tmp_path / "a.mcap", messages)
    fixes = open_source(tmp_path / "a.mcap").gnss
    assert fixes.geodetic.tolist() == [[47.0, 19.0, 100.0 + k] for k in range(3)]
    assert fixes.status.tolist() == [2, 2, 2]
    assert fixes.covariances_enu[2].tolist() == (0.25 * np.eye(3)).tolist()


def sentence(body):
    return f"${body}*{reduce(xor, body.encode()):02X}"


SENTENCES = [
    sentence("GPRMC,235959.50,A,4730.000,N,01902.000,E,0.1,0.0,311226,,,A"),
    sentence("GPGGA,235959.50,4730.000,N,01902.000,E,4,12,0.8,100.0,M,43.5,M,1.0,0001"),
    sentence("GPGST,235959.50,,,,,0.02,0.03,0.05"),
    sentence("GPGGA,000000.50,4730.600,S,01902.000,W,1,8,1.2,101.0,M,43.5,M,,"),
    "$GPGGA,000001.50,4730.600,S,01902.000,W,1,8,1.2,101.0,M,43.5,M,,*00",
    sentence("GPGGA,000002.50,,,,,0,,,,,,,,"),
]
"""Over midnight, an accuracy for the first, one damaged, one without a fix."""


def test_sentences_beside_a_log_are_fixes_with_times_of_utc(tmp_path):
    (tmp_path / "receiver.nmea").write_text("\r\n".join(SENTENCES) + "\r\n")
    gnss, notes = read_gnss(tmp_path)
    midnight_s = datetime(2027, 1, 1, tzinfo=UTC).timestamp()
    assert (gnss.stamps_ns / NS_PER_S).tolist() == [midnight_s - 0.5, midnight_s + 0.5]
    np.testing.assert_allclose(
        gnss.geodetic, [[47.5, 19 + 2 / 60, 143.5], [-47.51, -19 - 2 / 60, 144.5]], atol=1e-9
    )
    assert gnss.status.tolist() == [2, 0]
    np.testing.assert_allclose(np.sqrt(gnss.covariances_enu[0].diagonal()), [0.03, 0.02, 0.05])
    assert np.isnan(gnss.covariances_enu[1]).all()
    assert sum("1 damaged" in note for note in notes) == 1
    (tmp_path / "receiver.nmea").write_text("\n".join(SENTENCES[1:]))
    gnss, notes = read_gnss(tmp_path)
    assert gnss is None
    assert sum("date" in note for note in notes) == 1


@pytest.mark.parametrize(
    "body",
    [
        "GPRMC,xx,A,zz,N,yy,E,0,0,ab,,,A",
        "GPRMC,235959.50,A,4730.000,N,01902.000,E,0.1,0.0,999999,,,A",
        "GPZDA,201530.00,99,99,2002,00,00",
        "GPZDA,201530.00,1,1,99999999999,00,00",
        "GPZDA,201530.00,a,b,c,00,00",
        "GPGGA,235959.50,zz,N,yy,E,4,12,0.8,100.0,M,43.5,M,,",
        "GPGGA,235959.50,nan,N,inf,E,4,12,0.8,100.0,M,43.5,M,,",
        "GPGGA,235959.50,4730.0,N,01902.0,E,x,12,0.8,100.0,M,43.5,M,,",
        "GPGGA,235959.50,4730.0,Q,01902.0,E,1,12,0.8,100.0,M,43.5,M,,",
        "GPGGA,256199,4730.0,N,01902.0,E,1,12,0.8,100.0,M,43.5,M,,",
        "GPGGA,1,2",
        "GPGST,zz,,,,,1,1,1",
    ],
)
def test_a_malformed_field_costs_its_sentence(body):
    whole, _ = fixes_from_sentences("x", [(None, text) for text in SENTENCES[:3]])
    fixes, notes = fixes_from_sentences("x", [(None, text) for text in (sentence(body), *SENTENCES[:3])])
    assert fixes.stamps_ns.tolist() == whole.stamps_ns.tolist()
    np.testing.assert_array_equal(fixes.geodetic, whole.geodetic)
    np.testing.assert_array_equal(fixes.covariances_enu, whole.covariances_enu)
    assert sum("1 damaged" in note for note in notes) == 1


def test_sentences_of_a_recording_have_its_stamps_and_come_after_fixes(tmp_path):
    store, topic, type_ = receivers_store(), "/nmea_sentence", "nmea_msgs/msg/Sentence"
    messages = [
        *shots(3),
        *(
            message_of(store, type_, shot.stamp_ns, topic, sentence=text)
            for shot in shots(3)[::3]
            for text in SENTENCES[1:3]
        ),
    ]
    write(tmp_path / "a.mcap", messages)
    log = open_source(tmp_path / "a.mcap")
    assert log.gnss.stamps_ns.tolist() == [shot.stamp_ns for shot in shots(3)[::3]]
    np.testing.assert_allclose(log.gnss.sigmas_m, np.sqrt((0.02**2 + 0.03**2) / 2.0))
    place = {"geodetic": np.array([47.0, 19.0, 1.0]), "covariance_enu": np.eye(3), "status": 0}
    fix = fix_message(shots(1)[0].stamp_ns, "/fix", **place, frame="antenna")
    write(tmp_path / "b.mcap", [*messages, fix])
    assert open_source(tmp_path / "b.mcap").gnss.name == "/fix"
