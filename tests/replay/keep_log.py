"""Writes the tiny log that is kept of each version: `python -m tests.replay.keep_log` before a release, once.

A log in logs/ is never rewritten: it stands for the logs that users have.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from google.protobuf.json_format import MessageToDict

from protocols.log.read.reader import LogReader
from protocols.log.write.writer import LogWriter
from protocols.topics import NODE_STATE, TOPICS
from protocols.validation.rules import SCHEMA_VERSION
from tests.support.samples import SAMPLES

LOGS = Path(__file__).parent / "logs"


def content(path: Path) -> dict[str, Any]:
    """The content of a log, in a form that does not change when fields are added."""
    reader = LogReader(path)
    return {
        "messages": [
            {
                "topic": item.topic.name,
                "agent": item.agent,
                "site": item.site,
                "log_time_ns": item.log_time_ns,
                "message": MessageToDict(item.message, preserving_proto_field_name=True),
            }
            for item in reader.messages()
        ],
        "metadata": reader.metadata(),
        "attachments": {item.name: item.data.decode() for item in reader.attachments()},
        "damage": reader.damage,
        "counters": dict(reader.counters),
    }


def keep() -> Path:
    """Write this version's log and its content."""
    path = LOGS / f"v{SCHEMA_VERSION}.mcap"
    with LogWriter(path, {"syncline": {"seed": "7"}}, views=True) as log:
        log.attach("rig.toml", "application/toml", b"[cam0]\nsize = [640, 480]\n")
        # Hubs' talk among themselves about poses is of the moment: nobody replays it from an old log.
        for number, topic in enumerate(topic for topic in TOPICS if topic.recorded and topic is not NODE_STATE):
            agent = "hub" if topic.key.startswith("hub/") else "cam0"
            log.write(topic, agent, "yard", SAMPLES[topic](), 1_700_000_000_000_000_000 + number)
    path.with_suffix(".json").write_text(json.dumps(content(path), indent=1) + "\n", encoding="utf-8")
    return path


if __name__ == "__main__":
    print(keep())
