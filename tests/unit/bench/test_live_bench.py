"""The live scores find what was put in: lag errors, silences, latencies, moves, a bump and a late camera."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from protocols.core.clocks import NANOSECONDS, TimeMap
from protocols.geometry import so3
from protocols.geometry.pose import Similarity
from protocols.messages import syncline_pb2 as pb
from protocols.session.observations import Observations
from protocols.session.rig import Rig
from tests.bench import live
from tests.bench.live_run import Heard, Rows, session_cpu_s
from tests.bench.live_scores import LiveScores, Reference

SECONDS = 80.0
WORLD = Similarity(0.2, so3.exp(np.array([0.3, -0.8, 0.5])), np.array([4.0, 1.0, -2.0]))
"""Where the hub has the true world: unlike the truth's, as without a scale."""


@pytest.fixture(scope="module")
def reference() -> Reference:
    """The simulated rig; its offline path is not asked for."""

    def known(rig: Rig, seen: Observations) -> SimpleNamespace:
        path = SimpleNamespace(time=np.linspace(0.0, SECONDS, 9), position=np.zeros((9, 3)))
        cameras = {name: SimpleNamespace(time_map=TimeMap()) for name in rig.cameras}
        return SimpleNamespace(trajectories=[path], cameras=cameras, reference=next(iter(rig.cameras)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "calibrate", known)
        return live.simulated(SECONDS, 3)


def calibration(reference: Reference, names: list[str], revision: int) -> pb.Calibration:
    """The truth as a hub would tell it, in another world, on the clock of the first camera."""
    first = reference.cameras[names[0]].time_map
    message = pb.Calibration(schema_version=1, revision=revision, status="solved", reference_camera=names[0])
    for name in names:
        known = reference.cameras[name]
        assert reference.bump is not None
        poses = reference.bump.poses if revision > 2 else {one: c.pose for one, c in reference.cameras.items()}
        pose = WORLD.pose(poses[name])
        clock = known.time_map
        relative = TimeMap(
            clock.clock_rate / first.clock_rate, (clock.time_offset - first.time_offset) / first.clock_rate
        )
        message.cameras.add(
            camera=name,
            rotation=pose.rodrigues.tolist(),
            translation=pose.translation.tolist(),
            clock_rate=relative.clock_rate,
            time_offset=relative.time_offset,
            time_offset_std=0.0 if name == names[0] else 1e-3,
            position_std=[1e-3, 1e-3, 1e-3],
            matrix=known.intrinsics.matrix.ravel().tolist(),
            distortions=known.intrinsics.distortions.tolist(),
            lag_time_s=0.0,
        )
    return message


def heard_of(reference: Reference, lag_error_s: float = 0.0, latency_s: float = 0.03) -> Heard:
    """A hub that answers after 10 s and publishes every row's place ``latency_s`` after its arrival."""
    rows = sorted(
        (float(moment) + 0.05, name, float(time))
        for name in reference.rig.cameras
        for track in reference.seen.of_camera(name)
        for time, moment in zip(track.time, reference.common(name, track.time), strict=True)
    )
    zero = rows[0][0]
    kept = Rows(
        [name for _, name, _ in rows], np.array([t for *_, t in rows]), np.array([at - zero for at, *_ in rows])
    )
    early = [name for name in reference.rig.cameras if name != live.LATE]
    messages = [calibration(reference, early, 1), calibration(reference, list(reference.rig.cameras), 2)]
    messages += [calibration(reference, list(reference.rig.cameras), 3)]
    messages[1].cameras[1].time_offset += lag_error_s
    clock = reference.cameras[early[0]].time_map
    tracks = []
    for number, (at, name, time) in enumerate(rows):
        moment = reference.common(name, np.array([time]))
        if at - zero < 10.0:
            continue
        place = WORLD.points(
            np.array([np.interp(moment, reference.truth_time, reference.truth[:, k]) for k in range(3)]).T
        )
        own = (float(moment[0]) - clock.time_offset) / clock.clock_rate
        track = pb.Track(
            schema_version=1, sequence=number, state="confirmed", reference_time_ns=round(own * NANOSECONDS),
            position=place[0].tolist(),
        )  # fmt: skip
        tracks.append((at - zero + latency_s, track))
    end = kept.arrival[-1]
    statuses = [float(t) for t in np.arange(-2.0, end, 1.0) if not 20.0 < t < 24.5]
    cpu = [(float(t), 0.2 * float(t) + (0.3 * max(0.0, float(t) - 10.0))) for t in np.arange(-2.0, end + 1, 0.5)]
    answers = list(zip((10.0, 30.0, 50.0), messages, strict=True))
    return Heard(kept, answers, tracks, [], statuses, cpu, float(end) + 0.5)


def test_an_exact_hub_has_no_error(reference: Reference) -> None:
    found = LiveScores(heard_of(reference), reference).figures()
    assert found["first_calibration_s"] == 10.0
    assert found["all_calibrated_s"] == 30.0
    assert found["status_silence_s"] == pytest.approx(5.0)
    assert (found["cpu_before"], found["cpu_after"]) == (pytest.approx(0.2), pytest.approx(0.5))
    assert found["latency_median_ms"] == pytest.approx(30.0, abs=1.0)
    assert found["rows_without_track_percent"] < 0.1
    assert found["track_silence_s"] < 0.2
    assert found["track_coverage_percent"] > 98.0
    assert found["track_mean_cm"] < 0.3  # what interpolation of the truth leaves
    assert found["last_answer_mean_cm"] < 1.0
    assert found["lag_error_max_ms"] < 1e-3
    assert found["lag_z_within_3_percent"] == 100.0
    assert found["centre_moves_max_std"] is None  # nothing moved but the bumped camera
    assert found["bump_right_after_s"] == pytest.approx(10.0, abs=0.5)
    assert found["late_calibrated_after_s"] == pytest.approx(30.0 - SECONDS / 3.0, abs=1.0)


def test_what_is_wrong_is_found(reference: Reference) -> None:
    heard = heard_of(reference, lag_error_s=5e-3, latency_s=0.5)
    heard.calibrations[2][1].cameras[2].translation[0] += 0.01
    silent = [(at, track) for at, track in heard.tracks if not 60.0 < at < 63.0]
    found = LiveScores(replace(heard, tracks=silent), reference).figures()
    assert found["lag_error_max_ms"] == pytest.approx(5.0, rel=1e-3)
    assert found["lag_error_last_ms"] < 1e-3
    assert found["lag_z_max"] == pytest.approx(5.0, rel=1e-3)
    assert found["centre_moves_max_std"] == pytest.approx(10.0 / np.sqrt(3.0), rel=1e-3)
    assert found["latency_median_ms"] == pytest.approx(500.0, abs=1.0)
    assert found["latency_p99_ms"] > 2000.0
    assert found["track_silence_s"] == pytest.approx(3.0, abs=0.1)


def test_a_hub_without_an_answer_has_no_figures_but_its_silence(reference: Reference) -> None:
    found = LiveScores(replace(heard_of(reference), calibrations=[], tracks=[]), reference).figures()
    assert found["first_calibration_s"] is None
    assert found["status_silence_s"] == pytest.approx(5.0)
    assert "–" in live.table("nothing", found)


def test_the_cpu_of_children_counts_also_when_they_have_ended() -> None:
    work = "for _ in range(6_000_000): pass"
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {work!r}]); print(1, flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", parent], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    )
    try:
        assert process.stdout is not None
        process.stdout.readline()
        assert session_cpu_s(process.pid) > 0.05
    finally:
        process.kill()
        process.wait()
