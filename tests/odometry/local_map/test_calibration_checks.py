"""Checks of a camera's calibration together."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.odometry.local_map.calibration.calibration_checks import CalibrationChecks


@pytest.mark.parametrize(("registered", "said"), [(True, ["late", "focal"]), (False, ["late"])])
def test_intrinsics_are_not_judged_by_depth_of_other_pixels(registered, said):
    observation = SimpleNamespace(intrinsics=np.ones(5))
    checks = CalibrationChecks(SimpleNamespace(keyframes=[0], observation=lambda _: observation))
    checks._intrinsics = SimpleNamespace(contradictions=lambda _: ["focal"])
    checks._depth_images = SimpleNamespace(contradictions=lambda: ["late"], are_registered=registered)
    assert checks.contradictions() == said
