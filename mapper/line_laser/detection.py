"""Detection of the laser stripe in an image: each published method on its own, and their combination.

Somlyai (PhD thesis), §2.5.2; equations and figures are numbered as there.

Every method takes an image to the (H, W) uint8 response that it leaves; 0 is a pixel that it rejects.
"""

from collections.abc import Mapping
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.line_laser.config import StripeConfig

Method = Literal["hue", "intensity", "weight", "union", "edges", "combined"]
METHODS: tuple[Method, ...] = get_args(Method)

Response = NDArray[np.uint8]

_LOG_APERTURE = 5
_TWO_RED = np.array([[2.0, -1.0, -1.0]])


def hue(image: Image, *, from_deg: float, to_deg: float, saturation: int) -> Response:
    """Return the brightness of pixels of some hues (figure 2.2).

    Args:
        image: (H, W, 3) RGB.
        from_deg: First of the hues, 0 to 360°.
        to_deg: Last of them; less than the first if they pass through 0.
        saturation: Least saturation; pixels with less are grey.
    """
    hues, saturations, values = cv2.split(cv2.cvtColor(image, cv2.COLOR_RGB2HSV))
    degrees = 2.0 * hues
    after, before = degrees >= from_deg, degrees <= to_deg
    kept = (after & before if from_deg <= to_deg else after | before) & (saturations >= saturation)
    found: Response = values * kept
    return found


def intensity(red: Response, *, threshold: int) -> Response:
    """Return the brightness of bright pixels (eq. 2.39).

    Args:
        red: (H, W) red channel: light of the laser is red whatever it falls on (§2.5.2).
        threshold: Least brightness, k.
    """
    return _at_least(red, threshold)


def weight(image: Image, *, threshold: int) -> Response:
    """Return how red pixels are, 2R − G − B clipped to what a byte holds (eq. 2.40 and 2.41).

    Args:
        image: (H, W, 3) RGB.
        threshold: Least redness.
    """
    return _at_least(cv2.transform(image, _TWO_RED), threshold)


def edges(red: Response, *, sigma_px: float, threshold: int) -> Response:
    """Return the magnitude of the Laplacian of Gaussian where it is large; a line has several such edges.

    Args:
        red: (H, W) red channel.
        sigma_px: Standard deviation of the Gaussian; about that of the stripe's own profile.
        threshold: Least response of OpenCV's 5 × 5 mask, as a byte holds it: 150 is a stripe of some 20
            levels.
    """
    smooth = cv2.GaussianBlur(red.astype(np.float32), (0, 0), sigma_px)
    return _at_least(cv2.convertScaleAbs(cv2.Laplacian(smooth, cv2.CV_32F, ksize=_LOG_APERTURE)), threshold)


def combined(image: Image, config: StripeConfig) -> Response:
    """Return what :func:`responses` does by that name, without the methods that it does not need."""
    return _of_red(image, config)["combined"]


def responses(image: Image, config: StripeConfig) -> Mapping[Method, Response]:
    """Return what every method makes of an (H, W, 3) RGB image."""
    first, last = config.hue_from_deg, config.hue_to_deg
    hues = hue(image, from_deg=first, to_deg=last, saturation=config.saturation_threshold)
    return {"hue": hues, **_of_red(image, config)}


def _of_red(image: Image, config: StripeConfig) -> dict[Method, Response]:
    red = np.ascontiguousarray(image[:, :, 0])
    bright = intensity(red, threshold=config.intensity_threshold)
    reddish = weight(image, threshold=config.weight_threshold)
    union = np.maximum(reddish, bright)  # eq. 2.42
    edge = edges(red, sigma_px=config.edge_sigma_px, threshold=config.edge_threshold)
    both = cv2.bitwise_and(union, union, mask=edge)  # eq. 2.43
    return {"intensity": bright, "weight": reddish, "union": union, "edges": edge, "combined": both}


def stripe_rows(response: Response, *, join_px: int) -> Array:
    """Return (W,) rows of the stripe, NaN in columns without: the centre of mass of the strongest run.

    Args:
        response: (H, W), 0 where a method saw nothing.
        join_px: Pixels of one column with at most this number of others between are one run; the sum of its
            responses is its strength. Of a stripe that is burnt in, edges and colour leave the rims only.
    """
    height, width = response.shape
    # Zeros below each column keep a run from going on at the top of the next one.
    stride = height + join_px + 1
    columns = np.zeros((width, stride), np.uint8)
    columns[:, :height] = response.T
    flat = columns.ravel()
    marked = np.flatnonzero(flat)
    rows = np.full(width, np.nan)
    if not len(marked):
        return rows
    starts = np.flatnonzero(np.diff(marked, prepend=-stride) > join_px + 1)
    mass = flat[marked].astype(np.int64)
    strength = np.add.reduceat(mass, starts)
    centre = np.add.reduceat(mass * (marked % stride), starts) / strength
    weakest_first = np.argsort(strength, kind="stable")
    rows[marked[starts[weakest_first]] // stride] = centre[weakest_first]
    return rows


def _at_least(image: Response, threshold: int) -> Response:
    kept: Response = cv2.threshold(image, threshold - 1, 0, cv2.THRESH_TOZERO)[1]
    return kept
