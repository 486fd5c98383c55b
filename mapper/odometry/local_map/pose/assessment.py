"""Assessment of a tracked pose."""

from dataclasses import dataclass

from mapper.core.doubts import Doubt

UNOBSERVED_MOTION = "unobserved motion"
"""Kind of the doubt about a motion that nothing shows. Unlike others, it is measured by the covariance."""


@dataclass(frozen=True, slots=True)
class Assessment:
    """Doubts about a tracked pose, and how wrong it may be.

    Attributes:
        doubts: Reasons why it may be wrong; empty if there is none.
        sigma_rad: Error of the rotation that the reasons suggest, along each axis.
        sigma_m: Error of the translation.
        repeats: The image is that of the frame before, so that it does not show the pose.
        is_implausible: Few features show a jump, and most matches or the image contradict it.
    """

    doubts: tuple[Doubt, ...] = ()
    sigma_rad: float = 0.0
    sigma_m: float = 0.0
    repeats: bool = False
    is_implausible: bool = False


UNDOUBTED = Assessment()
