"""Registration: the motion between two scans, two images, or matched points."""
