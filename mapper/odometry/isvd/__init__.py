"""Visual odometry against a local map of keyframes, refined by local bundle adjustment."""
