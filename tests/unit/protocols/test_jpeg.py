"""JPEG images of others: what a header claims is not allocated."""

from __future__ import annotations

import struct
import tracemalloc

import cv2
import numpy as np
import pytest

from protocols.core.jpeg import MAX_JPEG_PIXELS, decode_jpeg, jpeg_size

SMALL = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()


def claiming(width: int, height: int) -> bytes:
    """A JPEG of some hundred bytes whose header gives another size."""
    at = SMALL.index(b"\xff\xc0") + 5
    return SMALL[:at] + struct.pack(">HH", height, width) + SMALL[at + 4 :]


@pytest.mark.parametrize("size", [(30_000, 30_000), (65_500, 65_500), (8193, 4096)])
def test_a_header_that_claims_too_much_is_not_decoded(size: tuple[int, int]) -> None:
    """600 bytes took 5 GB, or raised an error of OpenCV."""
    assert size[0] * size[1] > MAX_JPEG_PIXELS
    tracemalloc.start()
    try:
        assert decode_jpeg(claiming(*size)) is None
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_a_size_cannot_be_hidden_behind_what_decoders_skip() -> None:
    """Decoders skip FF 00 and search on; what it seemed to hold must not count as a segment."""
    large = claiming(30_000, 30_000)[2:]
    hidden = SMALL[:2] + b"\xff\x00" + struct.pack(">H", len(large) + 2) + large + SMALL[2:]
    assert jpeg_size(hidden) is None
    assert decode_jpeg(hidden) is None


def test_images_of_other_kinds_and_damaged_ones_are_none() -> None:
    assert decode_jpeg(b"") is None
    assert decode_jpeg(cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()) is None
    assert decode_jpeg(SMALL[:30]) is None
    image = decode_jpeg(SMALL)
    assert image is not None
    assert image.shape == (48, 64, 3)
