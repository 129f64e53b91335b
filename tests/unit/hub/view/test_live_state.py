"""What the live page says while it waits, of tracks at camera rate, of lags over time, and of ailing agents."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from hub.view.lag_chart import lag_charts
from hub.view.lag_history import LAG_WINDOW_S, LagHistory
from hub.view.panels import camera_details, camera_table, overview, picture_tiles, recording_html, track_text
from hub.view.player import LogRecording, Player
from hub.view.scene_renderer import trail_segments
from hub.view.state import STALE_S, ViewState
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, OBSERVATION
from tests.support.samples import MATRIX, calibration, camera_info, observation, picture, status, track

SECOND = 1_000_000_000


def lagged(revision: int, offset: float = -1_758_248_739.777, rate: float = 1.0, at: float = 0.0) -> pb.Calibration:
    """cam1's clock relative to cam0's. at: the camera time of the std."""
    message = pb.Calibration(schema_version=1, status="solved", state="calibrated", revision=revision)
    message.reference_camera, message.scale, message.units, message.solver = "cam0", "metric", "m", "joint"
    for name, moved in (("cam0", 0.0), ("cam1", offset)):
        found = message.cameras.add(camera=name, boot_id="b", clock_rate=1.0, time_offset=moved, rms_px=0.4)
        found.rotation[:], found.translation[:], found.matrix[:] = [0.0] * 3, [0.0] * 3, MATRIX
    found.clock_rate, found.lag_time_s, found.time_offset_std = rate, at, 1e-4
    return message


def waiting(state: str, status_word: str = "refused") -> pb.Calibration:
    """A hub that has no calibration."""
    message = pb.Calibration(schema_version=1, status=status_word, state=state, reason="too little shared motion")
    message.refused.append(pb.Refusal(camera="cam0", reason="its motion is too slow"))
    return message


def seen(label: str = "marker", time: float = 0.0, state: str = "confirmed") -> pb.Track:
    """A track at a reference time [s]."""
    message = track()
    message.label, message.state, message.reference_time_ns = label, state, round(time * SECOND)
    message.position[0] = time
    return message


def test_a_lag_is_the_change_since_the_first_one_at_the_time_of_its_std() -> None:
    """The intercept moves by 0.2 s, but the lag where it was measured by 0.3 ms only."""
    state = ViewState()
    state.handle(lagged(1), 0.0)
    state.handle(lagged(2, -1_758_248_739.777 - 0.2 + 3e-4, 1.0 + 2e-5, 1e4), 2.0)
    first, second = state.cameras["cam1"].lags.samples
    assert first.lag == 0.0
    assert second.lag == pytest.approx(3e-4, abs=1e-6)
    assert second.std == 1e-4
    assert state.cameras["cam1"].lags.first == pytest.approx(-1_758_248_739.777)


def test_a_revision_counts_once_and_another_clock_starts_anew() -> None:
    state = ViewState()
    for moment in (0.0, 1.0):
        state.handle(lagged(1), moment)
    assert len(state.cameras["cam1"].lags.samples) == 1
    restarted = lagged(2, 5.0)
    restarted.cameras[1].boot_id = "b2"
    state.handle(restarted, 2.0)
    assert [sample.lag for sample in state.cameras["cam1"].lags.samples] == [0.0]
    restarted.revision, restarted.cameras[0].boot_id = 3, "b2"
    state.handle(restarted, 3.0)
    assert len(state.cameras["cam1"].lags.samples) == 1, "the reference clock is another one too"


def test_a_history_of_days_stays_bounded() -> None:
    history = LagHistory()
    for index in range(20_000):
        history.add(lagged(index).cameras[1], ("b",), 2.0 * index)
    assert len(history.samples) <= 1000
    assert len(history.recent(2.0 * index)) == round(LAG_WINDOW_S / 2)


def test_the_lag_chart_has_a_strip_with_its_band_for_each_camera() -> None:
    state = ViewState()
    assert "first calibration" in lag_charts(state, 0.0)
    generator = np.random.default_rng(3)
    for index in range(100):
        state.handle(lagged(index, 7200.0 + generator.normal(0.0, 1e-4)), 2.0 * index)
    text = lag_charts(state, 200.0)
    assert re.findall(r"data-lag='(\w+)' data-revisions='(\d+)'", text) == [("cam0", "100"), ("cam1", "100")]
    assert text.count('class="band"') == 1, "the reference clock has no lag"
    assert text.count('class="rms"') == 2
    assert re.search(r"cam1</b> [+\u2212]0\.\d{3} ± 0\.200\u202fms", text), "in ms, not in hours"
    assert "nan" not in text


def test_a_name_cannot_put_markup_into_the_charts_and_tiles() -> None:
    state = ViewState()
    message = lagged(1)
    message.cameras[1].camera = "<script>'"
    state.handle(message, 0.0)
    state.handle(seen("<script>'"), 0.0)
    for text in (lag_charts(state, 1.0), picture_tiles(state, 1.0, wanted=True), overview(state, 1.0)):
        assert "<script" not in text


def test_after_a_seek_the_chart_shows_earlier_revisions(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        for index in range(0, 400, 10):
            log.write(CALIBRATION, "hub", "local", lagged(index + 1, 5.0 + 1e-6 * index), index * SECOND)
            log.write(OBSERVATION, "cam0", "local", observation("cam0", index), index * SECOND)
    player = Player(LogRecording(tmp_path / "a.mcap"))
    player.seek(380.0)
    samples = player.state.cameras["cam1"].lags.samples
    assert len(player.state.cameras["cam1"].lags.recent(380.0)) == 30
    assert samples[-1].lag == pytest.approx(3.8e-4)
    assert player.state.cameras["cam1"].lags.first == pytest.approx(5.0), "the recording's first"


def test_a_track_at_camera_rate_stays_bounded_and_its_newest_point_is_shown() -> None:
    state = ViewState()
    for index in range(120 * 60):
        state.handle(seen(time=index / 120), index / 120)
        path = state.paths["marker"]
        assert path.points[-1][0] == pytest.approx(index / 120)
    table = path.array()
    assert len(table) < 1000
    assert table[-1, 0] - table[0, 0] > 20.0
    assert np.diff(table[:-1, 0]).max() < 0.05
    assert path.array(59.0)[0, 0] >= 59.0
    assert path.count == 120 * 60


def test_a_track_coasts_falls_silent_and_is_lost_in_words() -> None:
    state = ViewState()
    state.handle(seen(), 0.0)
    assert "● marker: confirmed, seen by 3 cameras" in overview(state, 0.1)
    coasting = seen(time=0.9, state="coasting")
    coasting.unseen_s = 0.9
    state.handle(coasting, 0.9)
    assert "◌ marker: coasting, unseen for 0.9 s" in overview(state, 1.0)
    assert "data-state='coasting'" in overview(state, 1.0)
    assert "nothing heard of it for 9 s" in track_text(state.paths["marker"], 0.9 + STALE_S + 4.0)
    state.handle(seen(time=2.0, state="lost"), 2.0)
    assert state.paths == {}
    state.handle(seen("never", state="lost"), 2.0)
    assert state.paths == {}


def test_a_track_on_another_reference_clock_begins_anew() -> None:
    state = ViewState()
    state.handle(seen(time=1e6), 0.0)
    state.handle(seen(time=3.0), 0.1)
    assert state.paths["marker"].array()[:, 0].tolist() == [3.0]


def test_a_trail_has_gaps_where_nothing_came_and_dashes_where_it_coasted() -> None:
    times = np.concatenate([np.arange(0.0, 1.0, 0.02), np.arange(5.0, 7.0, 0.02)])
    table = np.column_stack([times, times, 0 * times, 0 * times, 0 * times, times >= 6.0])
    segments, ends = trail_segments(table)
    assert segments.shape == (len(ends), 2, 3)
    assert not ((ends > 1.0) & (ends < 5.01)).any(), "no line over the gap"
    assert np.allclose(np.diff(segments[:, :, 0]), 0.02, atol=1e-6)
    solid, dashed = ((ends > low) & (ends < low + 1.0) for low in (5.0, 6.0))
    assert solid.sum() >= 49
    assert 0.4 < dashed.sum() / solid.sum() < 0.6
    assert len(trail_segments(np.zeros((0, 6)))[0]) == len(trail_segments(table[:1])[0]) == 0


@pytest.mark.parametrize("word", ["collecting", "searching"])
def test_nothing_is_called_refused_unless_the_hub_says_so(word: str) -> None:
    state = ViewState()
    state.handle(camera_info("cam0"), 0.0)
    state.handle(observation("cam0"), 0.0)
    state.handle(waiting(word), 0.0)
    camera = state.cameras["cam0"]
    assert camera.state(0.1) == word
    assert state.headline() == f"{word}: too little shared motion"
    for text in (overview(state, 0.1), camera_table(state, 0.1), camera_details(state, camera, 0.1)):
        assert "refused" not in text
    for said in (waiting("refused"), waiting("", "refused")):
        state.handle(said, 0.0)
        assert camera.state(0.1) == "refused"
        assert "refused: its motion is too slow" in camera_table(state, 0.1)
    assert camera.refusals == 1
    old = waiting("", "searching")
    state.handle(old, 0.0)
    assert (state.hub_state, camera.state(0.1)) == ("searching", "searching"), "a status without a state"


def test_the_progress_of_each_camera_is_said() -> None:
    state = ViewState()
    state.handle(observation("cam0"), 0.0)
    message = waiting("searching")
    message.progress.add(camera="cam0", state="searching", shared_motion_s=34.4, margin=1.26, reason="two lags fit")
    message.progress.add(camera="cam9", state="collecting")
    state.handle(message, 0.0)
    text = camera_table(state, 0.1)
    assert "searching: two lags fit · 34 s of motion shared with another camera · best lag 1.3 times" in text
    assert state.cameras["cam9"].state(0.1) == "silent"
    good = calibration()
    good.state = "degraded"
    good.progress.add(camera="cam0", state="degraded", reason="it was moved")
    state.handle(good, 0.2)
    assert state.cameras["cam0"].state(0.2) == "degraded"
    assert state.cameras["cam0"].pose is not None
    assert state.headline().startswith("degraded: 1 camera, lags ± 0.1 ms")
    assert "▲ cam0" in camera_table(state, 0.2)


def test_an_ailing_agent_is_in_the_headline_within_five_seconds() -> None:
    state = ViewState()
    state.handle(observation("cam0"), 0.0)
    for agent, role in (("cam0", "camera"), ("hub", "hub"), ("rec", "record")):
        message = status(agent)
        message.role = role
        state.handle(message, 0.0)
    assert state.problems(1.0) == []
    assert "data-syncline='health'" not in overview(state, 1.0)
    for agent, role in (("cam0", "camera"), ("hub", "hub"), ("rec", "record")):
        ill = status(agent, 1)
        ill.role, ill.state, ill.message = role, "degraded", "too <hot>"
        state.handle(ill, 1.0)
        assert f"{agent}: too &lt;hot&gt;" in overview(state, 1.1)
        ill.state = "running"
        state.handle(ill, 1.2)
        assert state.problems(1.3) == []
        ill.state = "starting"
        ill.counters["alarms"] = 1
        state.handle(ill, 1.3)
        assert state.problems(1.3) == [f"{agent}: too <hot>"]
        ill.counters.pop("alarms")
        state.handle(ill, 1.4)
    state.handle(observation("cam0", 1), 6.0)
    assert state.problems(6.5) == ["hub has sent no status for 5 s", "rec has sent no status for 5 s"]
    state.presence("hub", "hub", alive=False, boot="boot-1")
    assert state.problems(2.0)[0] == "hub has ended"
    assert state.of_role("hub") == []
    last = status("hub", 2)
    last.role, last.state, last.message = "hub", "stopping", "it was stopped"
    state.handle(last, 2.0)
    assert state.problems(2.0)[0] == "hub has ended: it was stopped", "though its last status was read after its end"
    state.presence("hub", "hub", alive=True, boot="boot-1")
    assert state.problems(2.0)[0] == "hub is being stopped: it was stopped", "only the router had gone"
    assert "cam0 has sent no frames for 4 s" in state.problems(10.0)


def test_of_a_degraded_hub_the_page_says_what_is_wrong_and_leaves_the_rest_to_the_rows() -> None:
    """What the rows of the cameras and the advice say was said twice more, in bold, on half a page."""
    state, ill = ViewState(), status("hub")
    ill.role, ill.state = "hub", "degraded"
    ill.message = (
        "the times of cam2 stand still; 4 cameras calibrated; heard but not calibrated: dark (no rows); wave it"
    )
    state.handle(ill, 0.0)
    state.handle(observation("cam0"), 0.0)
    assert state.problems(1.0) == ["hub: the times of cam2 stand still"]
    state.handle(status("rec"), 0.0)
    state.agents["rec"].status.role, state.agents["rec"].status.state = "record", "degraded"
    assert "stand still<br>▲ rec: " in overview(state, 1.0)
    ill.message = "4 cameras calibrated; heard but not calibrated: dark (no rows)"
    assert state.problems(1.0)[0] == f"hub: {ill.message}"


def test_many_problems_are_cut_short() -> None:
    state = ViewState()
    for index in range(10):
        state.handle(observation(f"cam{index}"), 0.0)
    assert len(state.problems(9.0)) == 4
    assert state.problems(9.0)[-1] == "7 more"


def test_the_page_says_whether_it_records_and_since_when() -> None:
    state = ViewState()
    assert "syncline record" in recording_html(state, 0.0)
    message = status("rec")
    message.role, message.message, message.gauges["log_bytes"] = "record", "12 messages", 3_400_000.0
    state.handle(message, 1.0)
    assert "● rec: recording for more than 9 s, 12 messages, 3.4 MB" in plain(recording_html(state, 10.0 - 1e-9))
    message = pb.AgentStatus()
    message.CopyFrom(status("rec"))
    message.role, message.message, message.gauges["recording"] = "record", "paused after a.mcap", 0.0
    state.handle(message, 11.0)
    assert "○ rec: not recording, paused after a.mcap" in plain(recording_html(state, 12.0))
    again = pb.AgentStatus()
    again.CopyFrom(message)
    again.gauges["recording"], again.message = 1.0, "3 messages"
    for moment in (20.0, 21.0):
        state.handle(again, moment)
    assert "● rec: recording for 4 s, 3 messages" in plain(recording_html(state, 24.0))
    again.state = "stopping"
    assert "data-recording='off'" in recording_html(state, 24.0)


def plain(text: str) -> str:
    """Text without markup."""
    return re.sub(r"<[^>]+>", "", text)


def test_every_camera_has_a_tile_with_the_detections_of_its_own_frame() -> None:
    state = ViewState()
    shown = picture("cam0")
    shown.jpeg = cv2.imencode(".jpg", np.zeros((90, 160, 3), np.uint8))[1].tobytes()
    for name in ("cam0", "cam1"):
        for index in range(100):
            state.handle(observation(name, index), 0.0)
    shown.frame, shown.width, shown.height = 40, 640, 480
    state.handle(shown, 0.0)
    text = picture_tiles(state, 1.0, wanted=True)
    first, second = text.split("data-picture='cam1'")
    assert "<circle cx='321' cy='240.8'" in first, "(320.5, 240.25) from the corner of the image"
    assert "src='data:image/jpeg;base64," in first
    assert "1 detection" in first
    assert "sends no pictures" in second
    assert "picture 9 s old" in picture_tiles(state, 9.0, wanted=True)
    assert "sends no frames" in picture_tiles(state, 9.0, wanted=True).split("data-picture='cam1'")[1]
    assert "switched off" in picture_tiles(state, 1.0, wanted=False)
    place = shown.jpeg.index(b"\xff\xc0") + 5
    shown.jpeg = shown.jpeg[:place] + (65_000).to_bytes(2, "big") * 2 + shown.jpeg[place + 4 :]
    assert "<img" not in picture_tiles(state, 1.0, wanted=True), "an image that claims an enormous size"


def test_an_empty_site_says_what_to_do() -> None:
    state = ViewState()
    assert "syncline camera camera.toml" in overview(state, 0.0)
    assert "syncline hub hub.toml" in overview(state, 0.0)
    assert ViewState(is_live=False).next_steps() == [], "a recording cannot be helped"
    state.handle(camera_info("cam0"), 0.0)
    state.handle(observation("cam0", points=0), 0.0)
    assert "syncline camera" not in overview(state, 0.0)
    assert "cam0 has not seen the target yet: move it in front of it" in overview(state, 0.0)
