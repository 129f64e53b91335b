"""Rules of observations compiled from their layout: a few operations on one large integer check every field at once.

Observations that one detector sends differ in their numbers only: tags and lengths stand at the same bytes. The layout
of an observation that has passed ``rules.check`` therefore validates the next ones of its shape. With the payload as
one little-endian integer N:

* ``N & structure == skeleton``: every tag, length and continuation bit of a varint is the same, and so are texts with
  few values and the signs of what must not be negative. The parser then finds the same fields at the same bytes.
* ``(N & values) + slack`` has no bit of ``high`` that ``wanted`` lacks. Doubles without their sign are ordered as the
  integers of their bits (IEEE 754), so a number in bounds plus the bound's distance to 2⁶³ leaves bit 63 clear; NaN
  and infinities are larger than every bound. A letter from the space on plus 0x60 sets bit 7.

Only covariances are computed with. What no layout matches is checked field by field: it is not refused for that, and
refusals with their reasons come from ``rules`` alone.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from protocols.core.ranges import MAX_PIXEL
from protocols.geometry import kernels
from protocols.geometry.types import Ints

_MAX_SIZE = 4096
"""Bytes of a message that is worth a layout: thirty people with all their fields."""
_MAX_LAYOUTS, _MAX_OF_SIZE = 512, 4  # until all are made anew; that are tried for messages of one length
_FIRST_LAYOUTS, _HITS_PER_LAYOUT = 64, 8
"""A layout costs about three checks: where shapes do not come again, no more of them are made."""
_LEAST_AT_ONCE = 8  # messages: of fewer the call of a kernel takes longer than they do one by one
_VARIABLE, _LITERAL, _TEXT = 0, 1, 2  # kinds of a layout's parts
_VARINTS = {0x08: 0, 0x20: 7, 0x28: 7, 0x30: 9, 0x38: 6}
"""Of an observation: most bytes of each varint, so that its bound holds (2⁵³, 2⁶², an hour); 0: as in the model."""
_STRINGS = {0x12: _VARIABLE, 0x1A: _VARIABLE}
"""Names of camera and boot, which are looked up once parsed."""
_DETECTION = 0x42  # tag of the observation's field 8
_DOUBLES = {0x09: (MAX_PIXEL, True), 0x11: (MAX_PIXEL, True), 0x19: (MAX_PIXEL, False), 0x21: (1.0, False)}
"""Of a detection: the bound of u, v, size, score, and whether it may be negative."""
_TEXTS = {0x2A: _TEXT, 0x42: _LITERAL, 0x62: _TEXT}
"""label, kind, target."""
_COLOUR, _COVARIANCE = 0x32, 0x3A  # tags of a detection's fields 6 and 7
_PACKED = {0x3A: (MAX_PIXEL**2, (1,)), 0x4A: (MAX_PIXEL, (0, 1)), 0x52: (MAX_PIXEL, (0, 1)), 0x5A: (MAX_PIXEL, (0, 1))}
"""covariance, head, foot, box: the bound, and which of the numbers may be negative."""


class _OddShapeError(Exception):
    """A message that no layout is made of."""


class Layout(NamedTuple):
    """See the module. text: 0x7F for each letter of a label; ones: 1 for each: a sum's bit 7 shows DEL.
    packed: the same for ``kernels.match_layouts``."""

    structure: int
    skeleton: int
    values: int
    slack: int
    high: int
    wanted: int
    text: int
    ones: int
    covariances: Callable[[bytes], tuple[float, ...]] | None
    packed: Ints


class _Builder:
    """Walks along a valid message and notes which bits are structure and which are numbers in bounds."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload
        size = len(payload)
        self.structure = bytearray(b"\xff" * size)
        self.values, self.slack, self.high, self.text = (bytearray(size) for _ in range(4))
        self.covariances: list[int] = []

    def layout(self) -> Layout:
        """The layout of the message; raises _OddShapeError."""
        self._fields(0, len(self.payload), self._of_observation)
        masks = [int.from_bytes(one, "little") for one in (self.structure, self.values, self.slack, self.high)]
        structure, values, slack, high = masks
        text = int.from_bytes(self.text, "little")
        ones = text // 0x7F
        unpack = None
        if self.covariances:
            gaps = [b - a - 24 for a, b in zip([-24, *self.covariances], self.covariances, strict=False)]
            unpack = struct.Struct("<" + "".join(f"{gap}x3d" for gap in gaps)).unpack_from
        skeleton = int.from_bytes(self.payload, "little") & structure
        parts, words = (structure, skeleton, values, slack, high, ones << 7), -(-len(self.payload) // 8)
        bits = np.frombuffer(b"".join(part.to_bytes(8 * words, "little") for part in parts), dtype=np.int64)
        by_word = bits.reshape(len(parts), words).T.ravel()
        packed = np.array([words, len(self.covariances), *by_word, *self.covariances], dtype=np.int64)
        return Layout(*parts, text, ones, unpack, packed)

    def _fields(self, at: int, end: int, field: Callable[[int, int], int]) -> None:
        """Process the fields of one message; each but the detections at most once."""
        seen = set()
        while at < end:
            tag = self.payload[at]
            if tag in seen and field != self._of_observation:
                raise _OddShapeError
            seen.add(tag)
            at = field(tag, at + 1)
        if at != end:
            raise _OddShapeError

    def _of_observation(self, tag: int, at: int) -> int:
        if tag in _VARINTS:
            return self._varint(at, _VARINTS[tag], even=tag == 0x38)
        if tag in _STRINGS:
            return self._string(at, _VARIABLE)
        if tag == _DETECTION:
            start, end = self._length(at)
            self._fields(start, end, self._of_detection)
            return end
        raise _OddShapeError

    def _of_detection(self, tag: int, at: int) -> int:
        if tag in _DOUBLES:
            self._double(at, *_DOUBLES[tag])
            return at + 8
        if tag in _TEXTS:
            return self._string(at, _TEXTS[tag])
        if tag not in _PACKED and tag != _COLOUR:
            raise _OddShapeError
        start, end = self._length(at)
        if tag == _COLOUR:
            self._fields(start, end, self._of_colour)
            return end
        if tag == _COVARIANCE and end > start:
            self.covariances.append(start)
        bound, signed = _PACKED[tag]
        for number, place in enumerate(range(start, end, 8)):
            self._double(place, bound, number in signed)
        return end

    def _of_colour(self, tag: int, at: int) -> int:
        return self._varint(at, 1)  # up to 127; others are literal

    def _varint(self, at: int, most: int, *, even: bool = False) -> int:
        """Free the value's bits of a varint of at most ``most`` bytes. even: zigzag, not negative."""
        end = at
        while self.payload[end] & 0x80:
            end += 1
        end += 1
        if end - at <= most:
            for place in range(at, end):
                self.structure[place] = 0x80
            if even:
                self.structure[at] |= 1
        elif most > 1:
            raise _OddShapeError
        return end

    def _length(self, at: int) -> tuple[int, int]:
        """Start and end of a field with a length."""
        size, shift = 0, 0
        while True:
            byte = self.payload[at]
            size, shift, at = size | (byte & 0x7F) << shift, shift + 7, at + 1
            if not byte & 0x80:
                return at, at + size

    def _string(self, at: int, kind: int) -> int:
        start, end = self._length(at)
        if kind == _TEXT and not self.payload[start:end].isascii():
            kind = _LITERAL
        for place in range(start, end) if kind != _LITERAL else ():
            self.structure[place] = 0x80 if kind == _TEXT else 0
            if kind == _TEXT:
                self.values[place], self.slack[place], self.high[place], self.text[place] = 0x7F, 0x60, 0x80, 0x7F
        return end

    def _double(self, at: int, bound: float, signed: bool) -> None:
        (bits,) = struct.unpack("<q", struct.pack("<d", bound))
        end = at + 8
        if not signed and self.payload[end - 1] & 0x80:  # -0.0: its sign would be that of the layout
            raise _OddShapeError
        self.structure[at:end] = (0 if signed else 1 << 63).to_bytes(8, "little")
        self.values[at:end] = (2**63 - 1).to_bytes(8, "little")
        self.slack[at:end] = (2**63 - 1 - bits).to_bytes(8, "little")
        self.high[at:end] = (1 << 63).to_bytes(8, "little")


class Layouts:
    """The layouts of observations that have passed all rules. A bounded number: the oldest make room."""

    def __init__(self) -> None:
        self._of_size: dict[int, list[Layout]] = {}
        self._made = self._hits = self._kept = 0
        self._packed: tuple[Ints, dict[int, tuple[Ints, list[Layout]]]] = np.zeros(_MAX_SIZE + 1, dtype=np.int64), {}
        """Of each size the address of its layouts' addresses, and what is there; replaced, never changed."""

    def match_all(self, payloads: Sequence[bytes]) -> Sequence[int]:
        """Whether each of several certainly matches, and so need not be given to ``match``."""
        if len(payloads) < _LEAST_AT_ONCE or not kernels.AVAILABLE:
            return bytes(len(payloads))
        tables, kept = self._packed  # both, as another thread may learn meanwhile
        found = kernels.match_layouts(payloads, tables)
        self._hits += sum(found)
        del kept
        return found

    def match(self, payload: bytes) -> bool:
        """Whether an observation, names aside, is surely valid; its payload must be parsable."""
        layouts = self._of_size.get(len(payload))
        if layouts is None:
            return False
        whole = int.from_bytes(payload, "little")
        for structure, skeleton, values, slack, high, wanted, text, ones, covariances, _ in layouts:
            if whole & structure == skeleton:
                if ((whole & values) + slack) & high != wanted or (text and ((whole & text) + ones) & wanted):
                    return False
                if covariances is not None and not _are_covariances(covariances(payload)):
                    return False
                self._hits += 1
                return True
        return False

    def learn(self, payload: bytes) -> None:
        """Make a layout of an observation that has passed every rule."""
        if len(payload) > _MAX_SIZE or self._made >= _FIRST_LAYOUTS + self._hits // _HITS_PER_LAYOUT:
            return
        self._made += 1
        try:
            layout = _Builder(payload).layout()
        except (_OddShapeError, IndexError):
            return
        if self._kept >= _MAX_LAYOUTS:
            self._of_size, self._kept = {}, 0
            self._packed = np.zeros_like(self._packed[0]), {}
        kept = self._of_size.get(len(payload), [])
        if len(kept) < _MAX_OF_SIZE:
            self._kept += 1
        layouts = self._of_size[len(payload)] = [layout, *kept[: _MAX_OF_SIZE - 1]]
        addresses = np.array([*(one.packed.ctypes.data for one in layouts), 0], dtype=np.int64)
        tables = self._packed[0].copy()
        tables[len(payload)] = addresses.ctypes.data
        self._packed = tables, {**self._packed[1], len(payload): (addresses, layouts)}


def _are_covariances(values: tuple[float, ...]) -> bool:
    """Whether triples uu, uv, vv, the variances not negative, are positive semi-definite, without any tolerance."""
    numbers = iter(values)
    return all(uv * uv <= uu * vv for uu, uv, vv in zip(numbers, numbers, numbers, strict=True))
