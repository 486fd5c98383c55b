"""Doubt about a tracked pose."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Doubt:
    """Reasons why a pose may be wrong.

    Attributes:
        phrases: One for each reason; empty if there is none.
        sigma_rad: Error of the rotation that the reasons suggest, along each axis.
        sigma_m: Error of the translation.
        repeats: The image is that of the frame before, so that it does not show the pose.
        is_implausible: Few features show a jump, and most matches or the image contradict it.
    """

    phrases: tuple[str, ...] = ()
    sigma_rad: float = 0.0
    sigma_m: float = 0.0
    repeats: bool = False
    is_implausible: bool = False


NO_DOUBT = Doubt()
