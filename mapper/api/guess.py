"""First guess of a motion, parsed from a user's text or file."""

from pathlib import Path

import numpy as np

from mapper.core.errors import ConfigError
from mapper.core.geometry import Transform, is_rigid, transform
from mapper.core.rotations import pose_of_row, rotation_from_euler


def parse_guess(text: str | None) -> Transform:
    """Return the (4, 4) T_target_source of a guess; identity for None.

    Args:
        text: Six numbers, x y z in metres and roll pitch yaw in degrees; or a file with a 4×4 or 3×4 matrix,
            or a line of TUM (stamp x y z qx qy qz qw; the stamp may be absent).

    Raises:
        ConfigError: It is none of these.
    """
    if text is None:
        return np.eye(4)
    path = Path(text)
    is_file = path.is_file()
    numbers = _numbers(path.read_text(errors="replace") if is_file else text, text)
    if is_file and len(numbers) in (12, 16):
        rows = numbers.reshape(-1, 4)
        T_target_source = transform(rows[:3, :3], rows[:3, 3])
        if not is_rigid(T_target_source) or (len(rows) == 4 and not np.allclose(rows[3], [0, 0, 0, 1])):
            raise ConfigError(f"--guess {text}: the matrix is no rigid motion")
        return T_target_source
    if is_file and len(numbers) in (7, 8):
        return pose_of_row(numbers[-7:])
    if len(numbers) == 6:
        return transform(rotation_from_euler(*np.radians(numbers[3:])), numbers[:3])
    raise ConfigError(
        f'--guess {text}: {len(numbers)} numbers; want "x y z roll pitch yaw" in metres and degrees, '
        "or a file with a 4×4 matrix or a TUM line"
    )


def _numbers(content: str, text: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    lines = [line for line in content.splitlines() if not line.lstrip().startswith("#")]
    try:
        numbers = np.array([float(word) for line in lines for word in line.replace(",", " ").split()])
    except ValueError:
        raise ConfigError(
            f'--guess {text}: no such file, and not "x y z roll pitch yaw" in metres and degrees'
        ) from None
    if not np.isfinite(numbers).all():
        raise ConfigError(f"--guess {text}: a number is not finite")
    return numbers
