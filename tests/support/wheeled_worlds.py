"""Synthetic worlds driven through on wheels whose readings are exact."""

from mapper.simulation.config import STREET, SynthConfig, SynthWheelsConfig
from tests.support.ideal_sensors import IDEAL_LIDAR, IDEAL_SENSOR

EXACT = SynthWheelsConfig(path_sigma=0.0, turn_sigma=0.0, heading_rad_per_sqrt_m=0.0)
FLAT = SynthConfig(
    furniture_per_room=3,
    posters_per_room=2,
    texture_px_per_m=16,
    width_px=160,
    height_px=120,
    frame_rate_hz=6.0,
    duration_s=8.0,
    sensor=IDEAL_SENSOR,
    wheels=EXACT,
)
STREET_ON_WHEELS = STREET.model_copy(
    update={
        "loop_m": 60.0,
        "duration_s": 2.0,
        "slope_rad": 0.0,
        "undulation_m": 0.0,
        "wheels": EXACT,
        "sensor": IDEAL_LIDAR.model_copy(update={"rings": 16, "azimuth_steps": 300}),
    }
)
