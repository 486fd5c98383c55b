"""LiDAR logs made of folders of clouds: one module per layout."""
