"""Image features: detection, even distribution over the image, matching."""
