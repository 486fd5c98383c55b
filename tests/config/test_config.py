import json

import pytest

from mapper.config.build import BuildConfig
from mapper.config.loading import load_config, load_run_config, load_source_config, overridden
from mapper.core.config import Config
from mapper.core.errors import ConfigError, MapperWarning
from mapper.features.config import UniformOrbConfig
from mapper.octree.config import OctreeConfig
from mapper.odometry.config import IsvdOdometryConfig, LocalMapConfig
from mapper.simulation.config import SynthConfig
from tests.support.paths import CONFIGS


@pytest.fixture
def toml(tmp_path):
    def write(text):
        path = tmp_path / "lab.toml"
        path.write_text(text)
        return path

    return write


def test_the_defaults_are_those_of_the_sensor():
    assert load_config() == load_config(sensor="rgbd") == BuildConfig()
    config = load_config(sensor="lidar")
    assert (config.odometry.kind, config.loops.kind, config.slice.above) == ("gicp", "scans", "ground")
    assert config.octree.resolution_m == 0.2
    assert load_config(CONFIGS / "lidar_outdoor.toml", sensor="lidar") == config  # which spells them out


def test_an_override_wins_over_the_file_and_leaves_the_rest(toml):
    config = load_config(toml("[octree]\nresolution_m = 0.2\nmax_range_m = 3\n"), ["octree.resolution_m=0.1"])

    assert config.octree.resolution_m == 0.1
    assert config.octree.max_range_m == 3.0
    assert config.slice == BuildConfig().slice


def test_one_knob_keeps_the_default_kind():
    config = load_config(overrides=["odometry.detector.max_features=500"])

    assert type(config.odometry) is LocalMapConfig
    assert config.odometry.detector == LocalMapConfig().detector.model_copy(update={"max_features": 500})


def test_one_knob_keeps_the_kind_of_the_file_and_its_default_detector(toml):
    config = load_config(
        toml('[odometry]\nkind = "isvd"\n'),
        ["odometry.previous_frames=2", "odometry.detector.max_features=500"],
    )

    assert config.odometry == IsvdOdometryConfig(
        previous_frames=2, detector=UniformOrbConfig(max_features=500)
    )


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("octree.resolution=0.1", "octree.resolution: unknown; did you mean resolution_m?"),
        ("octree.resolution_m=-1", "octree.resolution_m: want more than 0, not -1"),
        ("odometry.previous_frames=2", "odometry.local-map.previous_frames: unknown; odometry.kind=isvd"),
        ("odometry.max_deph_m=2", "odometry.local-map.max_deph_m: unknown; did you mean max_depth_m?"),
        ("resolution_m=0.1", "resolution_m: unknown; did you mean octree.resolution_m?"),
        ("odometry.detector.x=1", "detector.uniform-orb.x: unknown; known are kind, max_features, threshold"),
        ("odometry.kind=zip", "odometry: no kind 'zip'; want one of isvd, local-map, pnp, gicp, icp"),
        ("odometry.kind=gipc", "odometry: no kind 'gipc'; did you mean gicp?"),
        ("slice.above=roof", "slice.above: want 'floor' or 'ground', not roof"),
        ("octree.attributes=2", "octree.attributes: want true or false, not 2"),
        ("workers=many", "want a whole number, not many"),
        ("workers", "setting 'workers': want name=value, such as"),
        ("workers.x.y=1", "workers: want a whole number"),
        # What would fail late:
        ("octree.resolution_m=inf", "octree.resolution_m: want a finite number"),
        ("slice.min_height_m=nan", "slice.min_height_m: want a finite number"),
        ("source.camera.fx_px=500", "source.camera: … want fx_px, fy_px, cx_px and cy_px, all four"),
        ("source.camera.depth_in_color=0,0,0,0,0,0,0", "source.camera: … quaternion is zero"),
        ("source.camera.depth_distortion=0.1,0,0,0,0", "source.camera: … without depth_intrinsics_px"),
        ("slice.min_height_m=1.2", "slice: … max_height_m 1.2 must be above min_height_m 1.2"),
        ("octree.resolution_m=4", "octree.resolution_m is 4 m, … want at most 2.4"),
        ("cloud.voxel_m=20", "cloud.voxel_m is 20 m, where 0.02 m is usual; it is in metres"),
        ("slice.max_height_m=1200", "slice.max_height_m is 1200 m, where 1.2 m is usual"),
        ("odometry.keyframe_distance_m=300", "keyframe_distance_m"),
        # Lists:
        ("source.camera.distortion=0.1,0.2", "source.camera.distortion: 2 values are too few"),
        ("source.camera.distortion=0,0,0,0,0,0", "source.camera.distortion: want at most 5 values"),
        ("source.camera.distortion=0,a,0,0,0", "source.camera.distortion.1: want a number"),
        ("source.camera.distortion=[0,0,0,0,0", "source.camera.distortion: want a list, as in 1,2,3"),
    ],
)
def test_a_mistake_is_named_in_one_line(override, message):
    with pytest.raises(ConfigError) as caught:
        load_config(overrides=[override])
    assert all(part in str(caught.value) for part in message.split(" … "))
    assert "\n" not in str(caught.value)


def test_a_mistake_in_a_file_names_the_file(toml, tmp_path):
    (tmp_path / "config.json").write_text('{"octree": {"resolution": 0.1}}')
    for path, why in (
        (toml("[slice]\nmax_height = 2\n"), r"lab\.toml: slice\.max_height: unknown; did you mean max_h"),
        (tmp_path / "config.json", r"octree\.resolution"),  # of a user, not of a run
        (tmp_path / "none.toml", "No such file"),
    ):
        with pytest.raises(ConfigError, match=why):
            load_config(path, ["workers=1"])
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_config(toml("[slice\n"))


def test_a_run_s_own_json_gives_the_same_configuration(tmp_path):
    config = load_config(overrides=["odometry.kind=isvd", "source.first_frame=3"])
    path = tmp_path / "config.json"
    path.write_text(config.model_dump_json(indent=2))

    assert load_config(path) == config


def test_a_run_of_an_older_version_loses_the_settings_that_are_no_more(tmp_path):
    tree = BuildConfig().model_dump(mode="json")
    tree["odometry"]["former"], tree["odometry"]["detector"]["gone"] = 1, 2
    assert tree["loops"]["kind"] in tree["loops"]  # a setting is named as the union's member
    tree["loops"]["verification"]["gone"] = 3
    tree["octree"]["resolution_m"], tree["old_part"] = 0.1, {"a": 1}
    path = tmp_path / "config.json"
    path.write_text(json.dumps(tree))
    (tmp_path / "manifest.json").write_text("{}")
    names = r"odometry\.detector\.gone, odometry\.former, loops\.verification\.gone, old_part$"

    with pytest.warns(MapperWarning, match=names):
        loaded = load_run_config(path)
    with pytest.warns(MapperWarning, match=names):
        again = load_config(path)

    assert loaded == again == BuildConfig(octree=OctreeConfig(resolution_m=0.1))


def test_any_configuration_can_be_overridden_and_a_part_that_was_missing_be_set():
    config = overridden(SynthConfig(), ["sensor.axial_noise_ratio=0", "seed=5"])
    assert (config.sensor.axial_noise_ratio, config.seed) == (0.0, 5)
    assert (
        overridden(BuildConfig(), ["octree.depth_noise.constant_m=0.01"]).octree.depth_noise.constant_m
        == 0.01
    )


CAMERA = [f"source.camera.{name}=1" for name in ("fx_px", "fy_px", "cx_px", "cy_px")]


@pytest.mark.parametrize(
    "text",
    ["0.1,0.2,0,0,0", "0.1, 0.2, 0, 0, 0,", "[0.1,0.2,0,0,0]", "(0.1, 0.2, 0, 0, 0)", "[0.1, 2e-1, 0, 0, 0]"],
)
def test_every_spelling_of_a_list_is_understood(text):
    config = load_config(overrides=[*CAMERA, f"source.camera.distortion={text}"])
    assert config.source.camera.distortion == (0.1, 0.2, 0.0, 0.0, 0.0)


def test_lists_in_any_part_are_understood():
    overrides = ["odometry.kind=icp", "odometry.pair_distances_m=[1.5, 0.5]"]
    assert load_config(overrides=overrides, sensor="lidar").odometry.pair_distances_m == (1.5, 0.5)
    mounted = load_config(overrides=["source.wheels.body_in_base=(0, 0, 1, 0, 0, 0, 1)"]).source.wheels
    assert mounted.body_in_base == (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Lists(Config):
    names: tuple[str, ...] | None = None
    pairs: tuple[tuple[float, float], ...] = ()
    parts: tuple[OctreeConfig, ...] = ()
    text: str = ""


@pytest.mark.parametrize(
    ("override", "want"),
    [
        ("names=icp, 'gicp'", Lists(names=("icp", "gicp"))),
        ("names=[]", Lists(names=())),
        ("pairs=((1, 2), (3, 4))", Lists(pairs=((1.0, 2.0), (3.0, 4.0)))),
        ('parts=[{"resolution_m": 0.1}]', Lists(parts=(OctreeConfig(resolution_m=0.1),))),
        ("text=1,2", Lists(text="1,2")),
    ],
)
def test_lists_of_text_lists_and_parts_are_understood(override, want):
    assert overridden(Lists(), [override]) == want


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_configuration_is_valid(path):
    assert load_config(path) != BuildConfig()


@pytest.mark.parametrize("name", ["lidar-indoor", "lidar_indoor"])
def test_a_preset_is_the_shipped_file_of_its_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    preset = load_config(name, sensor="lidar")
    assert preset == load_config(CONFIGS / "lidar_indoor.toml", sensor="lidar") != load_config(sensor="lidar")
    (tmp_path / name).write_text("[octree]\nresolution_m = 0.3\n")
    assert load_config(name, sensor="lidar").octree.resolution_m == 0.3, "a file comes first"
    with pytest.raises(ConfigError, match="lidar-outdoor"):
        load_config("lidar-indor")


def test_turning_one_knob_leaves_the_others_of_its_part():
    """Parts may default to something else than their class does, as the loops' matching does."""
    default = load_config().loops.verification.match
    turned = load_config(None, ["loops.verification.match.max_ratio=0.7"]).loops.verification.match
    assert turned == default.model_copy(update={"max_ratio": 0.7})
    fallback = load_config(None, ["odometry.kind=isvd", "odometry.fallback.seed=7"]).odometry
    assert (fallback.fallback.filter, fallback.fallback.max_ratio) == ("none", 0.95)


def test_settings_are_values_by_name_dotted_or_nested(tmp_path):
    file = tmp_path / "lab.toml"
    file.write_text("octree.resolution_m = 0.2\noctree.hit_probability = 0.8\n")
    dotted = load_config(str(file), settings={"octree.resolution_m": 0.1, "odometry.kind": "isvd"})
    assert dotted == load_config(file, ["octree.resolution_m=0.1", "odometry.kind=isvd"])
    nested = load_config(file, settings={"octree": {"resolution_m": 0.1}, "odometry": {"kind": "isvd"}})
    assert nested == dotted
    assert nested.octree.hit_probability == 0.8
    with pytest.raises(ConfigError, match=r"octree\.resolution: unknown; did you mean resolution_m"):
        load_config(settings={"octree.resolution": 0.1})


def test_another_kind_leaves_out_the_settings_of_the_former():
    isvd = load_config(settings={"odometry.kind": "isvd", "odometry.previous_frames": 2})
    for changed in (
        overridden(isvd, ["odometry.max_depth_m=4", "odometry.kind=pnp"]),
        overridden(isvd, settings={"odometry": {"kind": "pnp", "max_depth_m": 4.0}}),
    ):
        assert changed.odometry.kind == "pnp"
        assert changed.odometry.max_depth_m == 4.0
    assert overridden(isvd, ["odometry.kind=isvd"]) == isvd


@pytest.mark.parametrize("load", [load_config, load_source_config])
@pytest.mark.parametrize("settings", [["octree.resolution_m=0.1"], "octree.resolution_m=0.1", {1: 2}])
def test_settings_that_are_not_by_name(load, settings):
    with pytest.raises(
        ConfigError, match=r"^settings .*: want values by name, \{'octree.resolution_m': 0.1\}$"
    ):
        load(settings=settings)


def test_one_knob_turned_leaves_the_sensors_others_and_another_kind_takes_its_own(toml):
    path = toml("[octree]\nresolution_m = 0.1\n")
    config = load_config(
        path, ["slice.max_height_m=3.0", "odometry.kind=kiss-icp", "loops.kind=none"], sensor="lidar"
    )
    assert (config.octree.resolution_m, config.octree.max_range_m) == (0.1, 80.0)
    assert (config.slice.max_height_m, config.slice.min_height_m) == (3.0, 0.3)
    assert (config.odometry.kind, config.odometry.map_voxel_m, config.loops.kind) == ("kiss-icp", 1.0, "none")


def test_the_source_is_known_before_the_sensor(toml):
    path = toml("[source]\nstride = 2\n[odometry]\ncell_m = 0.4\n")  # a knob that no RGB-D odometry has
    source = load_source_config(path, ["source.first_frame=3", "odometry.voxel_m=0.3"])
    assert (source.stride, source.first_frame) == (2, 3)
    assert load_config(path, sensor="lidar").odometry.cell_m == 0.4
    with pytest.raises(ConfigError, match=r"source\.strid"):
        load_source_config(None, ["source.strid=2"])
