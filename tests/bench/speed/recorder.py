"""The recorder's writer beside the mcap library's own and Foxglove's SDK, all encoding the same messages."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from protocols.log.layout import schema_of
from protocols.log.write.writer import LogWriter
from protocols.topics import FLIGHT_IMAGE, OBSERVATION, Topic
from protocols.validation.codec import encode
from tests.bench.logs import KEY, image_messages, messages, raw_writer
from tests.bench.speed.rows import Limit, Row, Section, interleaved


def _ours(path: Path, topic: Topic, items: list[Any]) -> None:
    with LogWriter(path) as log:
        for index, item in enumerate(items):
            log.write(topic, "cam0", "local", item, index)


def _foxglove(path: Path, items: list[Any]) -> None:
    """With its default chunks and checksums."""
    import foxglove
    from foxglove import Channel, Context, Schema
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions

    context = Context()
    options = MCAPWriteOptions(compression=MCAPCompression.Zstd)
    with foxglove.open_mcap(path, context=context, writer_options=options):
        known = schema_of(KEY)
        assert known is not None
        schema = Schema(name=known.name, encoding="protobuf", data=known.data)
        channel = Channel(KEY, schema=schema, message_encoding="protobuf", context=context)
        for index, item in enumerate(items):
            channel.log(encode(item), log_time=index)


def measure(quick: bool, data: Path) -> Section:
    """CPU of whole logs, least of some interleaved rounds."""
    del data
    found = Section()
    kinds: tuple[tuple[str, Topic, list[Any]], ...] = (
        ("200 B", OBSERVATION, messages(5_000 if quick else 50_000)),
        ("100 KB", FLIGHT_IMAGE, image_messages(60 if quick else 500)),
    )
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "x.mcap"
        for title, topic, items in kinds:

            def fresh(write: Callable[[], None]) -> Callable[[], None]:
                def run() -> None:
                    path.unlink(missing_ok=True)
                    write()

                return run

            methods: dict[str, Callable[[], None]] = {
                "ours": fresh(lambda topic=topic, items=items: _ours(path, topic, items)),  # type: ignore[misc]
                "raw": fresh(lambda items=items: raw_writer(path, [encode(item) for item in items])),  # type: ignore[misc]
            }
            try:
                import foxglove  # noqa: F401

                methods["foxglove"] = fresh(lambda items=items: _foxglove(path, items))  # type: ignore[misc]
            except ImportError:
                found.missing.append(f"recorder, {title}, beside foxglove-sdk: not installed (extra dev)")
            seconds = interleaved(methods, 3 if quick else 5)
            rate = {way: len(items) / value for way, value in seconds.items()}
            work = f"recorder, {title} messages"
            found.rows.append(
                Row(work, rate["ours"], "/s", "mcap's own writer", rate["raw"], less=False, must=Limit("ratio", 0.8))
            )
            if "foxglove" in rate:
                must = Limit("ratio", 0.9) if title == "200 B" else None
                limits = {"must": must, "reach": Limit("ratio", 1.0)}
                found.rows.append(Row(work, rate["ours"], "/s", "foxglove-sdk", rate["foxglove"], False, **limits))
    return found
