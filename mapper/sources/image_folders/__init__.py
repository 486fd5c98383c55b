"""RGB-D logs made of folders of images: one module per layout."""
