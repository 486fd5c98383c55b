"""Grey images of 16 bits beside depth, which their encodings do not tell apart."""

import cv2
import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, TopicsConfig
from mapper.sources.ros.encode_ros import compressed_image_message
from mapper.sources.ros.typestore import typestore
from tests.support.recordings import COLOR, DEPTH, camera_info, image, shots, write
from tests.support.stereo_rig import RECTIFIED, SIZE_PX, projections, recorded
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, picture


def stamps(n):
    return [FIRST_NS + i * PERIOD_NS for i in range(n)]


def opened(path, messages):
    return open_source(write(path, messages))


def infrared(seed, *, bits=16):
    """Return a grey image of 16 bits of which some are used."""
    return picture(seed)[0][:, :, 1].astype(np.uint16) << (bits - 8)


def test_infrared_of_16_bits_is_not_taken_for_depth(tmp_path):
    messages = [message for message in shots(3) if message.topic != DEPTH]
    for i, t in enumerate(stamps(3)):
        messages += [image(t, f"/cam/{name}/image", picture(i)[1], "16UC1") for name in ("ir", "z")]
    assert opened(tmp_path / "a.mcap", messages).choices[0].startswith(f"colour {COLOR}, depth /cam/z/image")
    beside = [message for message in shots(3) if message.topic != DEPTH]
    beside += [image(t, "/cam/ir/image", infrared(i), "mono16") for i, t in enumerate(stamps(3))]
    with pytest.raises(SourceError, match=r"neither depth images.*16 bits are /cam/ir/image: source\.topics"):
        opened(tmp_path / "b.mcap", beside)


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
@pytest.mark.parametrize("bits", [10, 16])
@pytest.mark.parametrize("is_packed", [False, True])
def test_of_two_images_of_16_bits_the_one_of_few_outlines_is_depth(tmp_path, encoding, bits, is_packed):
    messages = [camera_info(t, "/cam/a/camera_info") for t in stamps(3)]
    for i, t in enumerate(stamps(3)):
        for topic, pixels in (("/cam/a/image", infrared(i, bits=bits)), ("/cam/b/image", picture(i)[1])):
            file, format_ = cv2.imencode(".png", pixels)[1].tobytes(), f"{encoding}; png compressed"
            packed = compressed_image_message(t, topic, file, format_=format_, frame="optical")
            messages.append(packed if is_packed else image(t, topic, pixels, encoding))
    log = opened(tmp_path / "a.mcap", messages)
    assert log.choices[0].startswith("colour /cam/a/image, depth /cam/b/image; ")
    frame = log.entry_at(0).load()
    assert np.abs(frame.gray.astype(int) - picture(0)[0][:, :, 1]).max() <= 1
    assert frame.depth_m.max() == pytest.approx(picture(0)[1].max() / 1000.0)


def test_which_of_two_alike_images_of_16_bits_is_depth_has_to_be_said(tmp_path):
    messages = [camera_info(t, "/cam/a/camera_info") for t in stamps(3)]
    for i, t in enumerate(stamps(3)):
        messages += [image(t, f"/cam/{name}/image", picture(i)[1], "mono16") for name in ("a", "b")]
    with pytest.raises(SourceError, match=r"16 bits are /cam/a/image, /cam/b/image: source\.topics\.color"):
        opened(tmp_path / "a.mcap", messages)
    topics = TopicsConfig(color="/cam/a/image", depth="/cam/b/image")
    assert open_source(tmp_path / "a.mcap", SourceConfig(topics=topics)).entry_at(0).load().gray.any()


def test_stereo_pairs_of_12_bits_are_as_bright_as_of_8(tmp_path):
    topics = "/ir/left/image_rect", "/ir/right/image_rect"
    eight = recorded(RECTIFIED, topics, projections=projections(0.12))
    twelve = []
    for message in eight:
        if message.type.endswith("/Image"):
            data = typestore("cdr").deserialize_cdr(message.cdr, message.type).data
            pixels = data.reshape(SIZE_PX[::-1]).astype(np.uint16) << 4
            message = image(message.stamp_ns, message.topic, pixels, "mono16", frame="optical")
        twelve.append(message)
    of_8, of_12 = (
        opened(tmp_path / f"{name}.mcap", messages).entry_at(0).load()
        for name, messages in (("a", eight), ("b", twelve))
    )
    np.testing.assert_array_equal(of_8.gray, of_12.gray)
    np.testing.assert_array_equal(of_8.depth_m, of_12.depth_m)
