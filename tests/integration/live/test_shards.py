"""Two hub processes share a street over Zenoh: one answer of both, one of each track, and the death of who leads."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

from tests.bench.shards import Site, errors, rms
from tests.faults.matrix import measured
from tests.support.long_street import street


def test_two_hubs_give_one_answer_and_one_takes_over(tmp_path: Path) -> None:
    rig, observations, arrivals, true, _ = street(7, 6, 150.0, 10.0, reach=4.0, stretch=4.0)
    with ExitStack() as stack:
        site = Site(stack, tmp_path, ["a", "b"], (rig, observations, arrivals))
        assert site.wait(lambda: len(site.shards) == 2, 60.0) < 60.0
        site.play()
        assert site.wait(lambda: site.is_split({"a", "b"}), 60.0) < 60.0, site.shards
        groups = site.groups()
        assert {len(group) for group in groups.values()} <= {2, 3, 4}
        assert site.wait(lambda: len(site.poses()) == 6, 120.0) < 120.0, site.parts
        assert site.publisher == "a"
        assert rms(errors(site.poses(), true, rig.cameras)) < 0.05
        assert site.wait(lambda: len(site.tracks) == 2, 60.0) < 60.0
        assert site.site is not None
        clock = site.site.reference_camera

        site.tracks.clear()
        site.wait(lambda: False, 2.0)
        shown = [
            {(track.label, track.reference_time_ns // 250_000_000) for track in site.tracks.get(hub, ())}
            for hub in "ab"
        ]
        assert all(shown)
        assert len(shown[0] & shown[1]) < 0.5 * len(shown[0] | shown[1]), "both only where a target is handed over"

        before = site.poses()
        site.kill("a")
        began = time.monotonic()
        assert site.wait(lambda: site.is_split({"b"}), 30.0) < 30.0
        assert site.wait(lambda: site.publisher == "b" and len(site.poses()) == 6, 30.0) < 30.0
        took = time.monotonic() - began
        measured("hub of two killed -9: the other has its cameras and answers", "≤ 5 s", f"{took:.2f} s", took <= 5.0)
        assert site.site.reference_camera == clock
        after = site.poses()
        moved = [float(sum((after[name].position - before[name].position) ** 2) ** 0.5) for name in before]
        size = float(sum((before["cam5"].position - before["cam0"].position) ** 2) ** 0.5)
        assert max(moved) < 0.02 * size, "the same world as before"
        assert site.wait(site.is_solved, 120.0) < 120.0, "b has heard all of them itself"
        assert rms(errors(site.poses(), true, rig.cameras)) < 0.05
