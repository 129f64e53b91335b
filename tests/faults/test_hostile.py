"""Hostile payloads: refused, counted by reason and source, and everything else continues."""

from __future__ import annotations

import time
from contextlib import ExitStack

import numpy as np
import pytest

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.security.sender_identity import SenderCheckedBus
from protocols.bus.settings import BusConfig
from protocols.bus.transport.session import open_session
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION
from tests.faults.fuzz import fuzz_config, fuzz_gate, fuzz_log, fuzz_mavlink, fuzz_rig
from tests.faults.matrix import measured
from tests.faults.processes import wait_until
from tests.support.receiving import collect, matched, sequences
from tests.support.samples import observation

IN_CI = 10_000


def bad(**fields: float) -> bytes:
    message = observation("cam0", 1)
    for name, value in fields.items():
        setattr(message.detections[0], name, value)
    return message.SerializeToString()


def other_version() -> bytes:
    message = observation("cam0", 1)
    message.schema_version = 99
    return message.SerializeToString()


def many() -> bytes:
    message = pb.Observation(schema_version=1, camera="cam0", boot_id="boot-1")
    message.detections.extend(pb.Detection(u=1.0) for _ in range(5000))
    return message.SerializeToString()


HOSTILE = {
    "truncated": (observation("cam0", 1).SerializeToString()[:-3], "garbled"),
    "oversized (2 MB)": (bytes(2_000_000), "oversized"),
    "NaN": (bad(u=float("nan")), "not_finite"),
    "inf": (bad(v=float("inf")), "not_finite"),
    "negative": (bad(size=-1.0), "out_of_range"),
    "out of range": (bad(u=1e9), "out_of_range"),
    "wrong version": (other_version(), "schema_version"),
    "huge counts": (many(), "too_many"),
    "deep nesting": (b"\x42\xff\xff\x03" + b"\x0b" * 60_000, "garbled"),
}


def test_hostile_payloads_are_refused_and_counted_by_reason_and_source() -> None:
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with ExitStack() as stack:
        stack.enter_context(Router(endpoint))
        receiving = SenderCheckedBus(stack.enter_context(open_bus("local", config, timeout_s=5.0)), time.monotonic)
        subscription = receiving.subscribe(OBSERVATION)
        sending = stack.enter_context(open_bus("local", config, timeout_s=5.0))
        hostile = matched(sending.publisher(OBSERVATION, "cam0"))
        good = matched(sending.publisher(OBSERVATION, "cam1"))
        expected: dict[tuple[str, str], int] = {}
        for number, (payload, reason) in enumerate(HOSTILE.values()):
            hostile._publisher.put(payload)  # type: ignore[attr-defined]  # past our own checks
            good.put(observation("cam1", number))
            expected[reason, "cam0"] = expected.get((reason, "cam0"), 0) + 1
        assert sequences(collect(subscription, len(HOSTILE))) == list(range(len(HOSTILE)))
        wait_until(lambda: subscription.drain() == [] and receiving.refusals_by_source() == expected)
    reasons = ", ".join(f"{count} {reason}" for (reason, _), count in expected.items())
    measured(
        "hostile payloads", "refused, counted by reason and source", f"{len(HOSTILE)} of {len(HOSTILE)}: {reasons}"
    )


def test_a_message_of_100_mb_does_no_harm() -> None:
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with ExitStack() as stack:
        stack.enter_context(Router(endpoint))
        receiving = stack.enter_context(open_bus("local", config, timeout_s=5.0))
        subscription = receiving.subscribe(OBSERVATION)
        good = matched(stack.enter_context(open_bus("local", config, timeout_s=5.0)).publisher(OBSERVATION, "cam1"))
        hostile = open_session(config, timeout_s=5.0)
        hostile.put(OBSERVATION.key_for("local", "cam0"), np.zeros(100_000_000, np.uint8).tobytes())
        for number in range(100):
            good.put(observation("cam1", number))
            time.sleep(0.02)
        assert sequences(collect(subscription, 100)) == list(range(100))
        assert "cam0" not in {item.agent for item in subscription.drain()}
        hostile.close()
    measured("a message of 100 MB", "refused, 0 crashes", "not delivered, another camera's 100 of 100 arrived")


def test_random_damage_never_gets_past_the_gate() -> None:
    counts = fuzz_gate(IN_CI, 1)
    refused = sum(sum(c.values()) - c["let in"] for c in counts.values())
    total = sum(sum(c.values()) for c in counts.values())
    assert all(sum(c.values()) == IN_CI for c in counts.values())
    assert all(c["let in"] and len(c) > 3 for c in counts.values()), "the damage is neither too small nor too large"
    measured(
        f"fuzz: {len(counts)} decoders of messages",
        "10⁴ each: 0 crashes, 0 non-finite past the gate",
        f"{total} inputs, {refused} refused, 0 crashes, 0 non-finite",
    )


def test_random_damage_never_gets_through_mavlink() -> None:
    pytest.importorskip("pymavlink")
    counts = fuzz_mavlink(IN_CI, 1)
    text = f"{sum(counts.values())} inputs, {counts['refused']} refused"
    measured("fuzz: MAVLink", "10⁴: 0 crashes, 0 non-finite", text)


def test_random_damage_to_a_configuration_is_reported_in_one_line() -> None:
    counts = fuzz_config(IN_CI // 5, 1)
    measured("fuzz: configuration", "one line each", f"{sum(counts.values())} inputs, {counts['refused']} refused")


def test_random_damage_to_a_rig_or_a_log_is_reported_in_one_line() -> None:
    for name, run in (("rig", fuzz_rig), ("log", fuzz_log)):
        counts = run(IN_CI // 20, 1)
        assert len(counts) > 1
        measured(f"fuzz: {name}", "one line each", ", ".join(f"{count} {kind}" for kind, count in counts.items()))
