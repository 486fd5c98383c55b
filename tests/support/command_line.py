"""The command line, run in the test's own process."""

from typer.testing import CliRunner, Result

from mapper.cli.main import app

HEAVY = {
    *("cv2", "numba", "gtsam", "matplotlib", "foxglove", "mcap", "pydantic", "numpy", "rich", "open3d"),
    *("kiss_icp", "kiss_matcher", "rerun", "distributed", "rosbags", "laspy"),
}
"""Packages that take long to import: help and completion do without."""


def invoke(*arguments: object) -> Result:
    """Run ``mapper`` with the arguments; what is no mistake of the user's is raised."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def mapper(*arguments: object, status: int = 0) -> Result:
    """Run ``mapper`` with the arguments and fail unless it exits with the status."""
    result = invoke(*arguments)
    assert result.exit_code == status, result.output
    return result
