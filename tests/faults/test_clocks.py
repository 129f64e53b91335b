"""Steps and rate changes of a camera's clock: reported, both segments kept separate, the offset estimated again."""

from __future__ import annotations

import numpy as np
import pytest

from edge import scenes
from edge.scenes.marker.scene import simulate_tracks
from hub.live.live_hub import LiveHub, LiveSettings
from protocols.messages import syncline_pb2 as pb
from tests.faults.matrix import measured

STEP_AT_S = 20.0


def stream(seconds: float, change: str, size: float) -> list[tuple[float, pb.Observation | pb.CameraInfo]]:
    """(true time, message) of three cameras; the clock of cam1 changes after STEP_AT_S."""
    scene = scenes.get_marker_scene("marker", 3, 3)
    filmed = simulate_tracks(scene, seconds, 3, pixel_noise=0.3, outlier_fraction=0.0, drop_fraction=0.0)
    out: list[tuple[float, pb.Observation | pb.CameraInfo]] = []
    rng = np.random.default_rng(1)
    for camera in scene.cameras:
        lens = camera.intrinsics
        info = pb.CameraInfo(
            schema_version=1, camera=camera.name, boot_id=f"boot-{camera.name}", width=lens.width, height=lens.height,
            fps=camera.fps, matrix=lens.matrix.ravel(), distortions=lens.distortions,
        )  # fmt: skip
        out.append((0.0, info))
        track = filmed[camera.name]
        start = min(t.time[0] / 1.0 for t in [track])
        for index in range(len(track)):
            time = float(track.time[index])
            true = (time - start) / camera.clock.rate
            after = max(0.0, true - STEP_AT_S) if camera.name == "cam1" else 0.0
            if after > 0.0:
                time += size if change == "step" else size * after
            message = pb.Observation(
                schema_version=1, camera=camera.name, boot_id=f"boot-{camera.name}", sequence=index,
                frame=int(track.frame[index]), device_time_ns=round(time * 1e9),
                detections=[pb.Detection(u=track.pixels[index, 0], v=track.pixels[index, 1], size=track.size[index])],
            )  # fmt: skip
            out.append((true + 0.002 + rng.exponential(3e-4), message))
    return sorted(out, key=lambda item: item[0])


@pytest.mark.parametrize("size", [10.0, -10.0])
def test_a_step_is_reported_at_once_and_the_offset_follows(size: float) -> None:
    hub = LiveHub(LiveSettings(interval_s=4.0, window_s=30.0))
    flagged = right = None
    before: float | None = None
    for true, message in stream(STEP_AT_S + 30.0, "step", size):  # 10 s more than the old side's rows are used
        hub.handle(message, 1000.0 + true)
        if flagged is None and hub.counters["clock_steps"]:
            flagged = true - STEP_AT_S
        for alarm in hub.tick(true):
            if isinstance(alarm, pb.Calibration) and alarm.status == "solved":
                found = {camera.camera: camera for camera in alarm.cameras}["cam1"]  # in every answer
                if found.boot_id == "boot-cam1":
                    before, middle = found.time_offset, found.lag_time_s
                elif right is None and before is not None:
                    right = true - STEP_AT_S
                    error = found.time_offset - (before - found.clock_rate * size)
                    assert found.lag_time_s == pytest.approx(middle + size, abs=3.0)  # on the clock as it is now
    assert flagged is not None
    assert right is not None
    assert hub.counters["clock_steps"] == 1
    measured(
        f"clock step of {size:+.0f} s",
        "reported, both sides separate, offset again ≤ 5 s",
        f"reported after {flagged:.2f} s, offset after {right:.2f} s to {abs(error) * 1e3:.2f} ms",
        right <= 5.0,
    )
    assert abs(error) < 0.01
    assert right <= 5.0


def test_a_step_too_small_for_the_stamps_is_seen_in_the_images_and_reported() -> None:
    hub = LiveHub(LiveSettings(interval_s=4.0, window_s=30.0))
    shown, maps = 0.0, list[tuple[float, float, float]]()
    for true, message in stream(STEP_AT_S + 8.0, "step", 0.04):
        hub.handle(message, 1000.0 + true)
        if isinstance(message, pb.Observation) and message.camera == "cam1":
            shown = message.device_time_ns * 1e-9
        for answer in hub.tick(true):
            if isinstance(answer, pb.Calibration) and answer.status == "solved":
                found = {camera.camera: camera for camera in answer.cameras}["cam1"]
                maps.append((true, found.clock_rate, found.time_offset))
    (_, rate, offset) = [one for one in maps if one[0] < STEP_AT_S][-1]
    error = maps[-1][1] * shown + maps[-1][2] - (rate * (shown - 0.04) + offset)
    assert hub.counters["clock_steps"] == 1
    assert hub.stream.clocks.alarms["cam1"].startswith("the clock of cam1 stepped by +0.0")
    assert abs(error) < 5e-3


def test_a_rate_change_of_200_ppm_is_reported() -> None:
    """Only the hub's own clock makes this observable; delays scatter by 0.3 ms here."""
    hub = LiveHub(LiveSettings(interval_s=1e9))
    flagged = None
    for true, message in stream(STEP_AT_S + 20.0, "drift", 2e-4):
        hub.handle(message, 1000.0 + true)
        if flagged is None and hub.counters["clock_drifts"]:
            flagged = true - STEP_AT_S
    assert flagged is not None
    assert hub.counters["clock_drifts"] == 1
    assert hub.counters["clock_steps"] == 0
    alarm = hub.stream.clocks.alarms["cam1"]
    measured("clock drift of 200 ppm", "reported, both sides separate", f"reported after {flagged:.1f} s: {alarm}")
    assert 100 < float(alarm.split()[-2]) < 300


def test_steady_clocks_raise_no_alarm() -> None:
    hub = LiveHub(LiveSettings(interval_s=1e9))
    for true, message in stream(40.0, "step", 0.0):
        hub.handle(message, 1000.0 + true)
    assert hub.counters["clock_steps"] == hub.counters["clock_drifts"] == 0
