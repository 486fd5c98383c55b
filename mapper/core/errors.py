"""Errors and warnings that a user can act on.

Library code raises or warns; only ``cli`` turns them into one line and, for an error, an exit status.
"""


class MapperError(Exception):
    """An error whose message names the thing, the value, the limit and the remedy."""


class ConfigError(MapperError):
    """A configuration file or an override that the model refuses."""


class DataError(MapperError):
    """Data that break a promise: wrong shape, not finite, out of order."""


class SourceError(MapperError):
    """A log that cannot be opened or read."""


class FrameError(SourceError):
    """One frame that cannot be read; the rest of the log may still be good."""


class TrackingError(MapperError):
    """Too little of a log could be tracked to make a map from it."""


class GraphError(MapperError):
    """A pose graph that is inconsistent or cannot be solved."""


class LoopError(MapperError):
    """A loop that cannot be added or removed, or two sessions that no loop ties."""


class MapSizeError(MapperError):
    """A map or a scan that would not fit into memory, refused before it is allocated."""


class MapFileError(MapperError):
    """A map file that is truncated, foreign or damaged."""


class VocabularyError(MapperError):
    """A vocabulary that is missing or damaged, or descriptors that it has no words for."""


class RegistrationError(MapperError):
    """Two clouds were registered, and the answer is not to be trusted."""


class PlanError(MapperError):
    """A path that does not exist, or an end of it where the robot has no room."""


class DependencyError(MapperError):
    """A library that an optional part needs, and that is not installed or cannot be loaded."""


class ViewerError(MapperError):
    """A viewer that cannot be started or reached."""


class RunError(MapperError):
    """A run folder that is missing, unfinished or already there."""


class MapperWarning(UserWarning):
    """A warning that a user should read; ``cli`` prints it as one line."""
