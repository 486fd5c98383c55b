"""The local map: keyframes and landmarks, in memory and paged to the disk."""
