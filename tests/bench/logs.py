"""Cost and robustness of logs: rates beside the raw MCAP writer, kill -9, cuts, flipped bytes.

    python -m tests.bench.logs [--quick] [--load-minutes 10]

Rates are the median of interleaved rounds in one process on one core. kill -9 goes to a real recorder behind a
Zenoh router that receives 200 observations a second; lost: from the last one in the log to the kill.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import Refused
from protocols.log.read.reader import LogReader
from protocols.log.read.recovery import recover
from protocols.log.write.writer import CHUNK_SIZE, LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, OBSERVATION, STATUS
from protocols.validation.codec import encode
from tests.integration.logs.test_record_replay import RECORDER

KEY = OBSERVATION.key_for("local", "cam0")


def messages(count: int) -> list[pb.Observation]:
    """Observations of four detections with covariance: about 200 bytes, none like another."""
    generator = random.Random(1)
    out = []
    for index in range(count):
        message = pb.Observation(
            schema_version=1,
            camera="cam0",
            boot_id="3f2a",
            sequence=index,
            frame=index,
            device_time_ns=index * 33_333_333,
        )
        for _ in range(4):
            u, v = generator.uniform(0, 1280), generator.uniform(0, 720)
            message.detections.append(pb.Detection(u=u, v=v, size=generator.uniform(5, 20), score=1.0, label="m"))
        out.append(message)
    return out


def image_messages(count: int, size: int = 100_000) -> list[pb.FlightImage]:
    """Images of 100 KB that compress no further, as JPEGs do, 30 a second."""
    generator = random.Random(5)
    return [
        pb.FlightImage(
            schema_version=1,
            agent="cam0",
            boot_id="3f2a",
            order=index,
            frame=index,
            device_time_ns=index * 33_333_333,
            width=1280,
            height=720,
            jpeg=b"\xff\xd8" + generator.randbytes(size - 4) + b"\xff\xd9",
        )
        for index in range(count)
    ]


def raw_writer(path: Path, payloads: list[bytes]) -> None:
    """The library's own writer, with our chunks and checksums."""
    with path.open("wb") as stream:
        log = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True)
        log.start()
        channel = log.register_channel(KEY, "protobuf", 0)
        for index, payload in enumerate(payloads):
            log.add_message(channel, log_time=index, data=payload, publish_time=index, sequence=index)
        log.finish()  # type: ignore[no-untyped-call]


def our_copy(path: Path, payloads: list[bytes]) -> None:
    with LogWriter(path) as log:
        for index, payload in enumerate(payloads):
            log.copy(KEY, payload, index, index, index)


def our_write(path: Path, items: list[pb.Observation], views: bool) -> None:
    with LogWriter(path, views=views) as log:
        for index, item in enumerate(items):
            log.write(OBSERVATION, "cam0", "local", item, index)


def median_cpu(folder: Path, rows: dict[str, Callable[[Path], object]], rounds: int) -> dict[str, float]:
    """CPU seconds of each row, the median of several rounds in turn."""
    times: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(rounds):
        for name, run in rows.items():
            path = folder / "x.mcap"
            path.unlink(missing_ok=True)
            began = time.process_time()
            run(path)
            times[name].append(time.process_time() - began)
    return {name: statistics.median(values) for name, values in times.items()}


def rates(folder: Path, count: int, rounds: int) -> None:
    items = messages(count)
    payloads = [encode(item) for item in items]
    rows: dict[str, Callable[[Path], object]] = {
        "mcap's writer, encoded messages": lambda path: raw_writer(path, payloads),
        "LogWriter.copy, encoded messages": lambda path: our_copy(path, payloads),
        "mcap's writer, encoding": lambda path: raw_writer(path, [encode(item) for item in items]),
        "LogWriter.write": lambda path: our_write(path, items, False),
        "LogWriter.write, with views": lambda path: our_write(path, items, True),
        "LogReader.messages": lambda path: sum(1 for _ in LogReader(folder / "kept.mcap").messages()),
        "LogReader.summary": lambda path: LogReader(folder / "kept.mcap").summary(),
        "recover": lambda path: recover(folder / "kept.mcap", path),
    }
    our_write(folder / "kept.mcap", items, False)
    medians = median_cpu(folder, rows, rounds)
    size = statistics.mean(len(payload) for payload in payloads)
    print(f"{count} observations of {size:.0f} bytes; CPU time, median of {rounds}")
    for name, seconds in medians.items():
        print(f"  {name:34} {count / seconds:>10,.0f}/s")
    raw, copied, raw_encoding, ours, viewed = list(medians.values())[:5]
    print(f"  against mcap's writer: copy {raw / copied:.2f} x its rate, write {raw_encoding / ours:.2f} x,", end="")
    print(f" write with views {raw_encoding / viewed:.2f} x")


def bandwidth(folder: Path, count: int, rounds: int) -> None:
    """Images of 100 KB, ours beside mcap's own writer."""
    items = image_messages(count)

    def ours(path: Path, views: bool) -> None:
        with LogWriter(path, views=views) as log:
            for item in items:
                log.write(FLIGHT_IMAGE, "cam0", "local", item, item.device_time_ns)

    rows: dict[str, Callable[[Path], object]] = {
        "mcap's writer, encoding": lambda path: raw_writer(path, [encode(item) for item in items]),
        "LogWriter.write": lambda path: ours(path, False),
        "LogWriter.write, with views": lambda path: ours(path, True),
    }
    medians = median_cpu(folder, rows, rounds)
    print(f"{count} images of 100 KB; CPU time, median of {rounds}")
    for name, seconds in medians.items():
        print(f"  {name:34} {count * 0.1 / seconds:>10,.0f} MB/s")
    raw, plain, viewed = medians.values()
    print(f"  against mcap's writer: write {raw / plain:.2f} x its bandwidth, with views {raw / viewed:.2f} x")


def seek(folder: Path, megabytes: int) -> None:
    """The first message at a random time of a large log, opened anew each time."""
    generator = random.Random(4)
    payloads = []
    for message in messages(50):
        detections = [pb.Detection(u=generator.uniform(0, 1280), v=generator.uniform(0, 720)) for _ in range(600)]
        message.detections.extend(detections)
        payloads.append(encode(message))
    path, count = folder / "large.mcap", 0
    with LogWriter(path) as log:
        while log.size < megabytes * 1e6:
            log.copy(KEY, payloads[count % 50], count, count, count)
            count += 1
    times = []
    for _ in range(30):
        start = generator.randrange(count)
        began = time.perf_counter()
        found = next(iter(LogReader(path).messages(start_ns=start)))
        times.append(1e3 * (time.perf_counter() - began))
        assert found.log_time_ns == start
    size = path.stat().st_size / 1e6
    path.unlink()
    print(f"seek in a log of {size:.0f} MB: median {statistics.median(times):.0f} ms, most {max(times):.0f} ms")


def load(folder: Path, seconds: float, rate_hz: int = 5000, streams: int = 4, picture_hz: int = 5) -> None:
    """Ten cameras, 5,000 observations a second in all, and four of 100 KB images, to a real recorder over Zenoh."""
    endpoint, path, cameras = free_endpoint(), folder / "load.mcap", [f"cam{i}" for i in range(10)]
    items, shown = messages(2000), image_messages(20)
    rounds, every = int(seconds * rate_hz / len(cameras)), rate_hz // len(cameras) // picture_hz
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus:
        publishers = {name: bus.publisher(OBSERVATION, name, rate_hz=rate_hz / len(cameras)) for name in cameras}
        images = {f"drone{i}": bus.publisher(FLIGHT_IMAGE, f"drone{i}") for i in range(streams)}
        statuses = bus.subscribe(STATUS, "recorder")
        process = subprocess.Popen([sys.executable, "-c", RECORDER, endpoint, str(path)], stdout=subprocess.PIPE)
        while not statuses.drain():
            time.sleep(0.01)
        for publisher in (*publishers.values(), *images.values()):
            publisher.wait_matched(10.0)  # what is put before anybody listens is no loss of the recorder's
        began, sent_images = time.monotonic(), 0
        status: list[Any] = []
        for number in range(rounds):
            item = items[number % len(items)]
            item.sequence = item.frame = number
            for name, publisher in publishers.items():
                item.camera = name
                publisher.put(item)
            for place, (name, publisher) in enumerate(images.items()):
                if (number + place * every // streams) % every == 0:
                    image = shown[sent_images % len(shown)]
                    image.agent, image.order = name, number
                    publisher.put(image)
                    sent_images += 1
            time.sleep(max(0.0, began + (number + 1) * len(cameras) / rate_hz - time.monotonic()))
            if number % 500 == 0:
                status = [received.message for received in statuses.drain()] or status
        took = time.monotonic() - began
        # What is still on its way is no loss: the recorder is stopped when it has had nothing new for two seconds.
        recorded, quiet = -1, time.monotonic()
        while time.monotonic() - quiet < 2.0 and time.monotonic() - began < took + 60.0:
            time.sleep(0.1)
            status = [received.message for received in statuses.drain()] or status
            if status and status[-1].counters["recorded"] - status[-1].sequence != recorded:
                recorded, quiet = status[-1].counters["recorded"] - status[-1].sequence, time.monotonic()
        before = os.times()
        process.send_signal(signal.SIGTERM)
        process.communicate()
        after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    counts = {
        kind: sum(entry.count for entry in LogReader(path).summary().topics if entry.key.endswith(f"/{kind}"))
        for kind in ("observation", "image")
    }
    sent = rounds * len(cameras)
    print(
        f"{sent / took:,.0f} observations/s and {streams} streams of {picture_hz} images/s for {took:.0f} s: ", end=""
    )
    print(f"{sent - counts['observation']} of {sent} and {sent_images - counts['image']} of {sent_images} ", end="")
    print(f"not in the log; recorder {cpu / took:.0%} of a core, log {path.stat().st_size / 1e6:.0f} MB")
    if status:
        print(f"  the recorder itself counted: {dict(status[-1].counters)}")
    path.unlink()


def kills(folder: Path, count: int) -> None:
    """kill -9 at random moments of a real recorder."""
    generator = random.Random(2)
    lost, unreadable = [], 0
    endpoint = free_endpoint()
    with Router(endpoint), open_bus("local", BusConfig(mode="client", connect=(endpoint,))) as bus:
        publisher = bus.publisher(OBSERVATION, "cam0")
        statuses = bus.subscribe(STATUS, "recorder")
        sequence = 0
        for trial in range(count):
            path = folder / f"k{trial}.mcap"
            process = subprocess.Popen([sys.executable, "-c", RECORDER, endpoint, str(path)])
            heard_at, lives = None, generator.uniform(0.6, 2.6)
            while heard_at is None or time.monotonic() < heard_at + lives:
                publisher.put(pb.Observation(schema_version=1, camera="cam0", boot_id="b", sequence=sequence))
                sequence += 1
                if heard_at is None and statuses.drain():
                    heard_at = time.monotonic()
                time.sleep(0.005)
            process.send_signal(signal.SIGKILL)
            killed_ns = time.time_ns()
            process.wait()
            statuses.drain()
            last = [item.log_time_ns for item in LogReader(path).messages([OBSERVATION])]
            fixed = recover(path, folder / "fixed.mcap")
            unreadable += fixed.messages == 0
            (folder / "fixed.mcap").unlink()
            lost.append((killed_ns - max(last)) / 1e9)
    print(
        f"kill -9 at {count} random moments: {unreadable} unreadable; lost: median {statistics.median(lost):.2f} s, "
        f"most {max(lost):.2f} s"
    )


def damaged(content: bytes, count: int) -> Iterator[tuple[str, bytes]]:
    generator = random.Random(3)
    for _ in range(count):
        yield "cut", content[: generator.randrange(8, len(content))]
        flipped = bytearray(content)
        for position in generator.sample(range(8, len(content)), 3):
            flipped[position] ^= 1 << generator.randrange(8)
        yield "3 bits flipped", bytes(flipped)
        begin = generator.randrange(8, len(content) - 4096)
        yield "4 KiB zeroed", content[:begin] + bytes(4096) + content[begin + 4096 :]


def damage(folder: Path, count: int) -> None:
    """Damaged copies of one log of 40 chunks: are they reported, repaired, and how much is left?"""
    items = messages(4000)
    with LogWriter(folder / "d.mcap") as log:
        for index, item in enumerate(items):
            log.write(OBSERVATION, "cam0", "local", item, index)
            if index % 100 == 99:
                log.sync()
    content = (folder / "d.mcap").read_bytes()
    written = {item.sequence: item for item in items}
    found: dict[str, list[float]] = {}
    reported = wrong = refused = 0
    for kind, data in damaged(content, count):
        (folder / "x.mcap").write_bytes(data)
        out = folder / "y.mcap"
        out.unlink(missing_ok=True)
        try:
            recovery = recover(folder / "x.mcap", out)
        except Refused:
            refused += 1
            reported += 1
            continue
        reported += bool(recovery.damage)
        with out.open("rb") as stream:
            for _, _, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
                read = pb.Observation.FromString(message.data)
                wrong += written[read.sequence] != read
        share = recovery.messages / (len(items) * (len(data) / len(content) if kind == "cut" else 1.0))
        found.setdefault(kind, []).append(share)
    total = 3 * count
    print(f"{total} damaged copies of a 40-chunk log: {reported} reported, {wrong} messages changed, {refused} refused")
    for kind, shares in found.items():
        print(f"  {kind:16} left of what stood there: median {statistics.median(shares):.1%}, least {min(shares):.1%}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--load-minutes", type=float, default=0.5, help="of 5,000 observations/s and 4 image streams")
    parser.add_argument("--only", choices=("rates", "bandwidth", "load", "seek", "damage", "kills"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        quick = options.quick
        parts: dict[str, Callable[[], None]] = {
            "rates": lambda: rates(folder, 20_000 if quick else 50_000, 3 if quick else 5),
            "bandwidth": lambda: bandwidth(folder, 100 if quick else 500, 3 if quick else 5),
            "load": lambda: load(folder, 5.0 if quick else 60.0 * options.load_minutes),
            "seek": lambda: seek(folder, 100 if quick else 1000),
            "damage": lambda: damage(folder, 30 if quick else 300),
            "kills": lambda: kills(folder, 6 if quick else 100),
        }
        for name, part in parts.items():
            if options.only in (None, name):
                part()
    return 0


if __name__ == "__main__":
    sys.exit(main())
