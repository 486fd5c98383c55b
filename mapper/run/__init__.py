"""The run folder: its files, its manifest, and how they are read back."""
