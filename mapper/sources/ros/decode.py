"""Recorded messages decoded, whatever their encoding."""

from mapper.core.errors import DataError
from mapper.sources.ros.messages import Message
from mapper.sources.ros.recording import Topic, check_block_size

_ZSTD = b"\x28\xb5\x2f\xfd"  # how its frames begin, and no CDR message does


def decompressed(topic: Topic, data: memoryview) -> memoryview:
    """Return a message as it was published: rosbag2 can compress each, and says so in metadata.yaml alone.

    Raises:
        DataError: It cannot be decompressed.
    """
    if topic.encoding != "cdr" or data[: len(_ZSTD)] != _ZSTD:
        return data
    import zstandard

    try:
        check_block_size(zstandard.frame_content_size(data))
        return memoryview(zstandard.decompress(data))
    except (zstandard.ZstdError, MemoryError) as error:
        raise DataError(f"a message that cannot be decompressed: {error}") from None


def decode(topic: Topic, data: memoryview) -> Message:
    """Return a decoded message; the payloads of ROS messages are views of ``data``.

    Raises:
        DataError: The message is damaged, or of a type or in an encoding that is not read.
    """
    try:
        if topic.encoding in ("cdr", "ros1"):
            from mapper.sources.ros.decode_ros import decode_ros  # loads rosbags

            return decode_ros(topic, decompressed(topic, data))
        from mapper.sources.ros.decode_foxglove import decode_foxglove

        return decode_foxglove(topic, data)
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"a damaged message: {error}") from None
