"""Paths as callers give them."""

import os

AnyPath = str | os.PathLike[str]
"""Path of a file or folder: text, or a ``pathlib.Path``."""
