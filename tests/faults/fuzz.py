"""Fuzzing of every decoder of received data with randomly damaged inputs; `make fuzz` does a million and more.

    python -m tests.faults.fuzz [--count N] [--seed S] [--seconds CPU_SECONDS]

Inputs are valid messages with bytes changed, cut, doubled, joined, lengths and numbers made extreme. An input must be
refused with a reason, or what comes out must be usable: every number finite. Anything else ends the run with the
input in hexadecimal.
"""

from __future__ import annotations

import argparse
import itertools
import math
import random
import struct
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from google.protobuf.message import Message

from protocols.validation.codec import admit, sender
from protocols.validation.rules import Rejected
from tests.support.samples import SAMPLES

_EXTREME = (
    struct.pack("<d", math.nan), struct.pack("<d", math.inf), struct.pack("<d", -1e308), b"\xff" * 10, b"\x0b" * 200,
    b"\x0a\xff\xff\xff\xff\x0f", b"\x00" * 9, struct.pack("<f", math.nan), b"\x80" * 11, b"\xf8\x7f",
)  # fmt: skip


def damaged(rng: random.Random, payloads: list[bytes]) -> bytes:
    """One input: a valid payload with one to eight kinds of damage."""
    data = bytearray(rng.choice(payloads))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(7)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif kind == 1 and data:
            data[at % len(data)] = rng.randrange(256)
        elif kind == 2:
            del data[at : at + rng.randint(1, 16)]
        elif kind == 3:
            data[at:at] = rng.randbytes(rng.randint(1, 16))
        elif kind == 4:
            data[at:at] = rng.choice(_EXTREME)
        elif kind == 5 and len(data) >= 8:
            where = rng.randrange(len(data) - 7)
            data[where : where + 8] = rng.choice(_EXTREME)[:8].ljust(8, b"\x00")
        else:
            other = rng.choice(payloads)
            data = data[:at] + bytearray(other[rng.randrange(len(other) + 1) :])
    return bytes(data)


# The last of each stand at the ends of the ranges that pass (`protocols.core.ranges`).
_NUMBERS = (
    math.nan, math.inf, -math.inf, -1.0, 0.0, 1e308, -1e308, 5e-324, 1e6, -1e-9, 1e5, 1e7, 1e9, -1e9, 1e11, -1e11, 1e-9,
)  # fmt: skip
_COUNTS = (0, 1, 2, 99, 2**31 - 1, 2**32 - 1, 2**53, 2**62, -(2**62), 2**63 - 1)
_TEXTS = ("", "cam0", "cam?", "**", "a" * 5000, "\x00", "\u202e", "-", "Cam0")


def spoiled(rng: random.Random, message: Message) -> bytes:
    """One input: a message that is well-formed to protobuf, with one to three fields set to invalid values."""
    copy = type(message)()
    copy.CopyFrom(message)
    for _ in range(rng.randint(1, 3)):
        one = copy
        while True:
            fields = [item for item in one.ListFields() if isinstance(item[0].name, str)]
            if not fields:
                break
            field, value = rng.choice(fields)
            inner = value if isinstance(value, Message) else None
            listed = list(value) if hasattr(value, "append") else []
            if listed and isinstance(listed[0], Message):
                inner = rng.choice(listed)
                if rng.random() < 0.2 and len(listed) < 10:
                    value.extend(listed * rng.choice((1, 50, 500)))
                    break
            if inner is not None:
                one = inner
                continue
            if listed or hasattr(value, "append"):
                _spoil_list(rng, value)
            elif not hasattr(value, "values"):
                with suppress(ValueError):  # beyond the field's bits
                    setattr(one, field.name, _absurd(rng, value))
            break
    return copy.SerializeToString()


def _spoil_list(rng: random.Random, values: Any) -> None:
    kind = rng.randrange(3)
    if kind == 0 and len(values):
        with suppress(ValueError):
            values[rng.randrange(len(values))] = _absurd(rng, values[0])
    elif kind == 1 and len(values):
        del values[rng.randrange(len(values)) :]
    elif 0 < len(values) < 1000:
        values.extend([values[0]] * rng.choice((1, 10, 3000)))


def _absurd(rng: random.Random, value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, float):
        return rng.choice(_NUMBERS)
    if isinstance(value, int):
        return rng.choice(_COUNTS)
    return rng.randbytes(rng.randrange(64)) if isinstance(value, bytes) else rng.choice(_TEXTS)


def all_finite(message: Message) -> bool:
    """Whether every number in a message, however deep, is finite."""
    for _, value in message.ListFields():
        whole = isinstance(value, str | bytes | int | float | Message)
        values = [value] if whole else value.values() if hasattr(value, "values") else value
        for one in values:
            if isinstance(one, Message):
                if not all_finite(one):
                    return False
            elif isinstance(one, float) and not math.isfinite(one):
                return False
    return True


def fuzz_gate(count: int, seed: int) -> dict[str, Counter[str]]:
    """``count`` inputs for every topic's decoder; counts by topic and reason ("" = accepted)."""
    out: dict[str, Counter[str]] = {}
    payloads = {topic.name: make().SerializeToString() for topic, make in SAMPLES.items()}
    for topic, make in SAMPLES.items():
        sample = make()
        rng, counts = random.Random(f"{seed} {topic.name}"), Counter[str]()
        name = sender(sample) or "cam0"
        key = topic.key_for("local", name)
        seeds = [payloads[topic.name]] * 7 + list(payloads.values())
        for _ in range(count):
            data = spoiled(rng, sample) if rng.random() < 0.5 else damaged(rng, seeds)
            try:
                _, message = admit(key, data)
            except Rejected as error:
                counts[error.reason.value] += 1
            except Exception as error:
                raise AssertionError(f"{topic.name}: {type(error).__name__} on {data.hex()}") from error
            else:
                assert all_finite(message), f"{topic.name}: not finite past the gate: {data.hex()}"
                counts["let in"] += 1
        out[topic.name] = counts
    return out


def fuzz_mavlink(count: int, seed: int) -> Counter[str]:
    """``count`` inputs for the MAVLink link: random damage to real frames; only finite messages come through."""
    from tests.faults.mavlink_frames import frames, message_receiver

    rng, counts = random.Random(f"{seed} mavlink"), Counter[str]()
    valid = frames()
    receive = message_receiver()
    for _ in range(count):
        data = damaged(rng, valid)
        try:
            received = receive(data)
        except Exception as error:
            raise AssertionError(f"mavlink: {type(error).__name__} on {data.hex()}") from error
        for one in received:
            values = [v for v in one.message.to_dict().values() if isinstance(v, float)]
            assert all(map(math.isfinite, values)), f"mavlink: not finite: {data.hex()}"
        counts["let in" if received else "refused"] += 1
    return counts


def fuzz_config(count: int, seed: int) -> Counter[str]:
    """``count`` inputs for the configuration reader: InputError, or a configuration."""
    from deploy.config.agents import CameraConfig
    from deploy.config.file import load

    valid = [
        b'id = "cam0"\nsite = "yard"\n[bus]\nmode = "client"\nconnect = ["tcp/127.0.0.1:7447"]\noutage_s = 60.0\n',
        b'id = "cam1"\ndriver = "simulated"\n[simulated]\nscene = "marker"\nseed = 3\ncameras = 4\n',
        b'id = "cam2"\n[bus]\noutage_s = 0x' + b"F" * 40 + b"\n[" + b'"!".' * 40 + b"a]\n",
    ]
    return _read_damaged("camera.toml", valid, count, seed, lambda file: load(file, CameraConfig))


def fuzz_rig(count: int, seed: int) -> Counter[str]:
    """``count`` inputs for the reader of rig.toml: InputError, or a rig whose lenses take any pixel."""
    from protocols.session.rig import read_rig

    lens = b"size = [640, 480]\nfps = 1e5\nmatrix = [[500.0, 0, 320.0], [0, 1e7, 240.0], [0, 0, 1]]\n"
    valid = [
        b"[cam0]\n"
        + lens
        + b"distortions = [1e9, -1e9, 1e9, -1e9, 1e9]\nposition = [1e11, 0, 0]\nposition_std = 1e-9\n",
        b'[cam_0]\nname = "../../evil"\n' + lens + b"distortions = [1e308, 0, 0, 0, 0]\n",
        b'["GoPro 2"]\n' + lens + b"fisheye = true\ndistortions = [-1e9, 1, 1, 1]\nrotation = [100, -100, 1e-300]\n",
        b".".join([b"a"] * 100) + b" = 1\n[cam0]\n" + lens,
        b"[cam0]\n" + lens + b"focal_std = 0x" + b"F" * 5000 + b"\n",
        b"".join(b"[cam%d]\nsize = [1, 65535]\n" % number for number in range(40)) + b"[metadata]\nunits = 'mm'\n",
    ]
    pixels = np.array([[0.0, 0.0], [1e6, -1e6], [320.0, 240.0]])

    def read(file: Path) -> None:
        for camera in read_rig(file).cameras.values():
            if camera.intrinsics is not None:
                camera.intrinsics.unproject(pixels)

    with np.errstate(all="ignore"):
        return _read_damaged("rig.toml", valid, count, seed, read)


def _read_damaged(name: str, valid: list[bytes], count: int, seed: int, read: Callable[[Path], object]) -> Counter[str]:
    """Read damaged files: each is let in, or refused in one line."""
    from protocols.core.errors import InputError

    rng, counts = random.Random(f"{seed} {name}"), Counter[str]()
    with TemporaryDirectory() as folder:
        file = Path(folder) / name
        for _ in range(count):
            file.write_bytes(damaged(rng, valid))
            try:
                read(file)
                counts["let in"] += 1
            except InputError as error:
                _one_line(str(error))
                counts["refused"] += 1
            except Exception as error:
                raise AssertionError(f"{name}: {type(error).__name__} on {file.read_bytes().hex()}") from error
    return counts


def fuzz_log(count: int, seed: int) -> Counter[str]:
    """``count`` inputs for the log reader: InputError, or all that is whole, and the memory of the largest chunk."""
    from protocols.core.errors import InputError
    from protocols.log.read.reader import LogReader
    from protocols.log.write.writer import LogWriter
    from tests.unit.protocols.log.test_bombs import FOOTER, MAGIC, chunk, false_heads

    rng, counts = random.Random(f"{seed} log"), Counter[str]()
    zeros = bytes(1 << 20)
    packed = {b"zstd": zstandard.ZstdCompressor().compress(zeros), b"lz4": lz4.frame.compress(zeros)}
    bombs = [
        MAGIC + chunk(name, data, says) + FOOTER for name, data in packed.items() for says in (1000, 1 << 20, 1 << 31)
    ]
    heads = [MAGIC + b"\xff" * 9 + false_heads(opcode, 2_000) for opcode in (6, 7, 9, 12, 0x90)]
    bombs.append(MAGIC + chunk(b"", b"\x0c" + bytes(8) + b"\x0c" + bytes(8), 18) + FOOTER)
    with TemporaryDirectory() as folder:
        good, file = Path(folder) / "good.mcap", Path(folder) / "damaged.mcap"
        with LogWriter(good) as log:
            log.attach("../../evil", "text/plain", b"x" * 100, 0)
            for topic, make in SAMPLES.items():
                log.write(topic, sender(make()) or "cam0", "local", make(), 1)
        valid = [good.read_bytes()] * len(bombs + heads) + bombs + heads
        for _ in range(count):
            file.write_bytes(damaged(rng, valid))
            try:
                reader = LogReader(file)
                reader.summary()
                for logged in reader.messages():
                    assert all_finite(logged.message)
                list(reader.attachments())
                list(reader.messages(start_ns=1))
                counts["damaged" if reader.damage else "whole"] += 1
            except InputError as error:
                _one_line(str(error))
                counts["refused"] += 1
            except Exception as error:
                raise AssertionError(f"log: {type(error).__name__} on {file.read_bytes().hex()}") from error
    return counts


def _one_line(text: str) -> None:
    if "\n" in text:
        raise AssertionError(f"more than one line: {text!r}")


def fuzz_all(count: int, seed: int) -> int:
    """Run each once, print its counts, and return the number of inputs."""
    total = 0
    others: tuple[tuple[str, Callable[[int, int], Counter[str]], int], ...] = (
        ("mavlink", fuzz_mavlink, count),
        ("config", fuzz_config, max(1, count // 10)),
        ("rig", fuzz_rig, max(1, count // 10)),
        ("log", fuzz_log, max(1, count // 20)),
    )
    for name, counts in (
        *fuzz_gate(count, seed).items(),
        *((name, run(number, seed)) for name, run, number in others),
    ):
        total += sum(counts.values())
        reasons = ", ".join(f"{number} {reason}" for reason, number in counts.most_common())
        print(f"{name}: {sum(counts.values())} inputs: {reasons}", flush=True)
    return total


def main() -> None:
    """Run all, again and again with another seed for as long as is asked, and print the counts."""
    parser = argparse.ArgumentParser(description="Random damage for every decoder.")
    parser.add_argument("--count", type=int, default=60_000, help="inputs for each topic's decoder")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--seconds", type=float, default=0.0, help="repeat until so much CPU time is used")
    words = parser.parse_args()
    total = 0
    for seed in itertools.count(words.seed):
        print(f"seed {seed}", flush=True)
        total += fuzz_all(words.count, seed)
        if time.process_time() >= words.seconds:
            break
    print(f"{total} inputs, 0 crashes, 0 non-finite values past the gate, {time.process_time():.0f} s of CPU")


if __name__ == "__main__":
    main()
