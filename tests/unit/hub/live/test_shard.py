"""Hubs that share a site, without a bus: who leads, who takes which cameras, and what a death and a restart change."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import pytest
from google.protobuf.message import Message

from hub.live.live_hub import LiveHub, LiveSettings
from hub.live.shard import ROLE, Shard
from protocols.messages import syncline_pb2 as pb
from protocols.validation.rules import check
from tests.support.samples import MATRIX


class Hubs:
    """Hubs and a street of cameras, in which one sees what those three before and after it see."""

    def __init__(self, names: str, cameras: int) -> None:
        self.now, self.hubs, self.cameras = 0.0, dict[str, Shard](), list(range(cameras))
        self.latched: dict[tuple[str, str], Message] = {}
        """Of each hub and topic the last message, which whoever joins gets."""
        self.published: deque[tuple[str, str, Message]] = deque(maxlen=64)
        for name in names:
            self.join(name)

    def join(self, name: str) -> None:
        shard = Shard(name, LiveHub(LiveSettings(track=False, least_rows=10**9)))
        for other, there in self.hubs.items():
            shard.on_liveliness(ROLE, other, "boot", alive=True)
            there.on_liveliness(ROLE, name, "boot", alive=True)
        for (other, topic), message in self.latched.items():
            if other in self.hubs:
                shard.admits(topic, other, message)
        self.hubs[name] = shard

    def die(self, name: str) -> None:
        del self.hubs[name]
        for there in self.hubs.values():
            there.on_liveliness(ROLE, name, "boot", alive=False)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Seconds until the condition holds."""
        begin = self.now
        while self.now < begin + seconds and not until():
            self.now += 0.25
            for name, shard in self.hubs.items():
                for camera in self.cameras:
                    info = pb.CameraInfo(
                        schema_version=1, camera=f"cam{camera:02d}", boot_id="b", width=640, height=480
                    )
                    info.matrix[:] = MATRIX
                    shard.admits("info", info.camera, info)
                    frame = pb.Observation(schema_version=1, camera=info.camera, boot_id="b")
                    for target in range(camera, camera + 4):
                        frame.detections.add(label=f"target{target}")
                    shard.admits("observation", frame.camera, frame)
                out = shard.outgoing(shard._hub.tick(self.now)) + shard.tick(self.now)
                for topic, message in out:
                    check(message)
                    self.latched[name, topic] = message
                    self.published.append((name, topic, message))
                    for other, there in self.hubs.items():
                        if other != name:
                            there.admits(topic, name, message)
        return self.now - begin

    def agreed(self) -> dict[str, list[str]]:
        """The groups, which all follow."""
        found = [shard.groups for shard in self.hubs.values()]
        assert all(one == found[0] for one in found)
        return found[0]


def test_hubs_agree_on_groups_and_hear_no_more_than_the_border() -> None:
    hubs = Hubs("abc", 24)
    hubs.run(6.0)
    assert hubs.agreed() == {}, "what overlaps is not known yet"
    hubs.run(6.0)
    groups = hubs.agreed()
    assert set(groups) == set("abc")
    assert sorted(map(len, groups.values())) in ([7, 8, 9], [8, 8, 8])
    assert {shard.leader for shard in hubs.hubs.values()} == {"a"}
    for name, shard in hubs.hubs.items():
        heard = shard._mine - set(groups[name])
        assert len(heard) <= 6, "three beyond each end"
        assert shard.ignored == {one for group in groups.values() for one in group} - shard._mine


def test_a_camera_that_joins_moves_no_other_and_one_that_leaves_is_dropped() -> None:
    hubs = Hubs("abc", 23)
    hubs.run(12.0)
    before = hubs.agreed()
    hubs.cameras.append(23)
    hubs.run(12.0)
    home = next(hub for hub, group in before.items() if "cam22" in group)
    assert hubs.agreed() == before | {home: [*before[home], "cam23"]}
    hubs.cameras.remove(23)
    for shard in hubs.hubs.values():
        shard.on_liveliness("camera", "cam23", "b", alive=False)
    hubs.run(20.0)
    assert hubs.agreed() != before, "it may come back"
    hubs.run(12.0)
    assert hubs.agreed() == before


@pytest.mark.parametrize("victim", ["a", "b"])
def test_a_death_is_a_new_split_at_once_and_a_restart_begins_from_what_is(victim: str) -> None:
    hubs = Hubs("abc", 24)
    hubs.run(12.0)
    hubs.die(victim)
    assert hubs.run(10.0, lambda: all(set(one.groups) == set(hubs.hubs) for one in hubs.hubs.values())) <= 0.5
    version = max(shard.version for shard in hubs.hubs.values())
    hubs.join(victim)
    hubs.run(5.0)
    assert set(hubs.agreed()) == set("abc")
    assert {shard.version for shard in hubs.hubs.values()} == {version + 1}


def test_who_takes_over_cameras_has_them_in_its_part_at_once() -> None:
    hubs = Hubs("ab", 12)
    hubs.run(12.0)
    site = pb.Calibration(schema_version=1, revision=7, status="solved", reference_camera="cam00", scale="arbitrary",
                          units="m", state="calibrated")  # fmt: skip
    for camera in hubs.cameras:
        site.cameras.add(camera=f"cam{camera:02d}", boot_id="b", clock_rate=1.0, matrix=MATRIX,
                         rotation=[0.0] * 3, translation=[-float(camera), 0.1 * (camera % 3), 0.0])  # fmt: skip
    hubs.hubs["b"].admits("calibration", "a", site)
    hubs.die("a")
    hubs.published.clear()
    hubs.run(1.5)
    parts = [message for name, topic, message in hubs.published if topic == "part"]
    published = [message for name, topic, message in hubs.published if topic == "calibration"]
    for messages in (parts, published):
        assert isinstance(messages[-1], pb.Calibration)
        assert len(messages[-1].cameras) == 12
    last = published[-1]
    assert isinstance(last, pb.Calibration)
    assert last.revision > 7
    assert last.cameras[5].translation[0] == pytest.approx(-5.0, abs=1e-6), "the same world"
