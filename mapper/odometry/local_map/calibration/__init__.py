"""The camera against its calibration: intrinsics, depth images, rolling shutter."""
