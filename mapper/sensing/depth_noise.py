"""What the noise of a depth says in pixels."""

import numpy as np

from mapper.config.depth_noise import DepthNoiseConfig
from mapper.geometry import Array


def pixel_weights(
    sigma_px: Array,
    depth_m: Array,
    *,
    virtual_baseline_px_m: float,
    disparity_sigma_px: float,
    depth_noise: DepthNoiseConfig | None,
) -> Array:
    """Return (N, 3) inverse variances, px⁻², of features' u, v and virtual disparity bf / z.

    Args:
        sigma_px: (N,) standard deviation of a feature's pixel.
        depth_m: (N,) its depth, NaN where there is none.
        virtual_baseline_px_m: bf.
        disparity_sigma_px: σ of the virtual disparity relative to that of the pixel, for a sensor whose
            noise is not known.
        depth_noise: The sensor's, where it is: then σ is bf / z² · σ_z.
    """
    sigma_disparity_px = sigma_px * disparity_sigma_px
    if depth_noise is not None:
        measured = virtual_baseline_px_m / depth_m**2 * depth_noise.sigma_m(depth_m)
        sigma_disparity_px = np.where(np.isnan(depth_m), sigma_disparity_px, measured)
    weights: Array = np.column_stack([sigma_px, sigma_px, sigma_disparity_px]) ** -2.0
    return weights
