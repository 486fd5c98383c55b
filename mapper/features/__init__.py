"""Image features: detection, spreading, matching."""
