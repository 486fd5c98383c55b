"""Mapping from solved poses: levelling (up and the floor), fusing of frames, the coloured cloud."""
