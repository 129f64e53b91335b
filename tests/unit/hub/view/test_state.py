"""The view state, its panels, access control and playback, without a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hub.view.image_planes import pixel_of
from hub.view.page import calibration_file, draw_detections
from hub.view.panels import ago, camera_details, camera_table, overview, picture_tiles
from hub.view.player import CalibrationRecording, LogRecording, Player
from hub.view.scene_renderer import fit_viewpoint
from hub.view.server import AccessControl, action_result, commands_for, is_local
from hub.view.state import SILENT_S, ViewState
from protocols.core.errors import InputError
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.session.calibration import read_calibration
from protocols.topics import CALIBRATION, CAMERA_INFO, OBSERVATION, TRACK
from protocols.validation.codec import encode
from tests.support.samples import calibration, camera_info, observation, picture, status, track

SECOND = 1_000_000_000


def filming(state: ViewState, camera: str = "cam0", seconds: float = 2.0, fps: float = 25.0, begin: int = 0) -> float:
    """Frames at ``fps`` up to ``seconds``; returns the time of the last one."""
    moment = 0.0
    for index in range(round(seconds * fps)):
        moment = index / fps
        state.handle(observation(camera, begin + index), moment)
    return moment


def test_frame_rate_and_lost_frames_follow_from_the_frames() -> None:
    state = ViewState()
    now = filming(state)
    camera = state.cameras["cam0"]
    assert camera.fps(now) == pytest.approx(25.0)
    assert (camera.frames, camera.lost, camera.restarts) == (50, 0, 0)
    state.handle(observation("cam0", 59), now + 0.4)
    assert camera.lost == 9
    state.handle(observation("cam0", 59), now + 0.5)
    assert camera.frames == 51, "a duplicate frame counts once"
    state.handle(observation("cam0", 3, boot_id="boot-2"), now + 0.6)
    assert (camera.restarts, camera.lost) == (1, 9), "another boot id may start at any sequence number"


def test_cameras_are_in_the_order_of_their_numbers() -> None:
    state = ViewState()
    for name in ("cam10", "cam2", "Tür", "7", "cam1"):
        filming(state, name, 0.1)
    assert list(state.cameras) == ["7", "Tür", "cam1", "cam2", "cam10"]


def test_of_a_calibration_nothing_is_said_of_frames_and_pictures() -> None:
    state = ViewState(is_static=True, is_live=False)
    state.handle(calibration(), 0.0)
    table, tiles = camera_table(state, 0.0), picture_tiles(state, 0.0, wanted=True)
    details = camera_details(state, state.cameras["cam0"], 0.0)
    assert "data-state='calibrated'" in table
    assert not any(word in table + tiles + details for word in ("never", "0.0</td>", "picture yet", "0 frames", "0 %"))
    assert "play its log" in tiles


def test_a_camera_is_calibrated_refused_silent_or_gone() -> None:
    state = ViewState()
    now = filming(state)
    camera = state.cameras["cam0"]
    assert camera.state(now) == "collecting"
    solved = calibration()
    state.handle(solved, now)
    assert camera.state(now) == "calibrated"
    assert camera.state(now + SILENT_S + 0.1) == "silent"
    refused = pb.Calibration(schema_version=1, status="refused", reason="moved", revision=9)
    refused.refused.append(pb.Refusal(camera="cam0", reason="it was moved"))
    state.handle(refused, now)
    assert (camera.state(now), camera.refused) == ("refused", "it was moved")
    assert camera.calibration is not None, "its last pose is still shown"
    state.presence("camera", "cam0", alive=False, boot="boot-1")
    assert camera.state(now) == "gone"


def test_the_panel_shows_the_figures_of_the_hub() -> None:
    state = ViewState()
    now = filming(state)
    message = calibration()
    state.handle(camera_info("cam0"), now)
    state.handle(message, now)
    found = message.cameras[0]
    text = camera_table(state, now)
    assert f"{1e3 * found.time_offset_std:.3f} ms" in text
    assert f"{found.time_offset:+.6f} s" in text
    assert f"{1e6 * (found.clock_rate - 1):+.1f} ppm" in text
    assert f"{found.rms_px:.2f} px" in text
    assert "25.0" in text
    assert "✓ cam0" in text
    assert "50 frames, target in 50" in camera_details(state, state.cameras["cam0"], now)


def test_names_and_reasons_cannot_put_markup_into_the_page() -> None:
    state = ViewState()
    info = camera_info("cam0")
    info.target = "<img src=x onerror='alert(3)'>"
    state.handle(info, 0.0)
    filming(state)
    bad = pb.Calibration(schema_version=1, status="refused", reason="<script>alert(1)</script>")
    bad.refused.append(pb.Refusal(camera="cam0", reason="<img src=x onerror='alert(2)'>\"'"))
    state.handle(bad, 2.0)
    for text in (overview(state, 2.0), camera_table(state, 2.0), camera_details(state, state.cameras["cam0"], 2.0)):
        assert "<script" not in text
        assert "<img" not in text
        assert "onerror='" not in text


def test_guidance_is_shown_while_something_is_missing() -> None:
    state = ViewState()
    info = camera_info("cam0")
    info.target = "ball"
    state.handle(info, 0.0)
    filming(state)
    assert "cam0 has seen the ball in" in overview(state, 2.0)
    assert "of its view: wave it" in overview(state, 2.0)
    assert ", ball in" in camera_details(state, state.cameras["cam0"], 2.0)


def test_while_nothing_is_solved_the_page_says_what_each_camera_is_waited_for() -> None:
    state = ViewState()
    filming(state)
    waiting = pb.Calibration(schema_version=1, status="collecting", state="collecting", reason="too few detections yet")
    waiting.progress.append(
        pb.CameraProgress(camera="cam0", state="collecting", shared_motion_s=4.0, reason="50 of 90 detections")
    )
    state.handle(waiting, 2.0)
    text = overview(state, 2.0)
    assert "<p data-waiting='cam0'>… cam0 <progress" in text
    assert "collecting: 50 of 90 detections · 4 s of motion shared with another camera · target seen in" in text
    assert "class='bad'" not in text + camera_table(state, 2.0), "nobody has to act yet"
    state.handle(pb.Calibration(schema_version=1, status="solved", state="calibrated"), 3.0)
    assert "data-waiting" not in overview(state, 3.0)


def test_a_view_without_its_router_says_so_first() -> None:
    state = ViewState()
    filming(state)
    state.lost_at = 4.0
    assert state.problems(7.2)[0] == "this view reaches no router for 3 s"
    assert "▲ degraded: this view reaches no router" in overview(state, 7.2)


def test_the_path_not_updated_for_longest_is_dropped() -> None:
    state = ViewState()
    for index in range(100):
        for label in (f"p{index}", "p0"):
            point = track(index)
            point.label = label
            state.handle(point, float(index))
    assert 10 < len(state.paths) < 60
    assert "p0" in state.paths
    assert "p99" in state.paths
    assert "p1" not in state.paths


def test_times_are_short() -> None:
    assert [ago(value, 100.0) for value in (None, 99.9, 70.0)] == ["never", "now", "30\u2009s"]
    assert ago(0.0, 600.0) == "10\u2009min"


def test_a_silent_camera_that_the_hub_has_forgotten_leaves_the_page() -> None:
    state = ViewState()
    for name in ("cam0", "cam1", "cam2"):
        state.handle(observation(name), 0.0)
    message = calibration()
    for name in ("cam0", "cam1"):
        message.progress.add(camera=name, state="calibrated")
    state.handle(message, 0.0)
    message.revision += 1
    del message.progress[:], message.cameras[:]
    state.handle(message, 0.1)
    assert set(state.cameras) == {"cam0", "cam1", "cam2"}, "they send frames"
    message.progress.add(camera="cam1", state="degraded")
    state.cameras["cam0"].progress = message.progress[0]
    state.handle(message, 60.0)
    assert set(state.cameras) == {"cam1", "cam2"}, "the hub has not heard of cam2 yet"
    assert "cam0" not in " ".join(state.problems(60.0) + state.next_steps())


def test_a_click_sends_one_command_to_each_agent_of_the_role() -> None:
    state = ViewState()
    for agent, role, boot in (("rec-a", "record", "b1"), ("rec-b", "record", "b2"), ("hub", "hub", "b3")):
        message = status(agent)
        message.role, message.boot_id = role, boot
        state.handle(message, 0.0)
    commands = commands_for(state, "stop_recording", "view-1", "boot", 4)
    assert [(c.agent, c.agent_boot, c.sequence) for c in commands] == [("rec-a", "b1", 4), ("rec-b", "b2", 5)]
    assert all(encode(command) for command in commands)
    assert commands_for(state, "recalibrate", "view-1", "boot", 0)[0].agent == "hub"
    assert commands_for(state, "forget", "view-1", "boot", 0)[0].action == "forget"
    assert action_result(state, "forget") == "requested from hub: forget silent cameras"
    assert action_result(state, "export") == "requested from hub: export"
    assert "not sent" in action_result(ViewState(), "export")


def test_calibration_toml_from_the_bus_equals_the_published_calibration(tmp_path: Path) -> None:
    state = ViewState()
    assert calibration_file(state) == ""
    message = calibration()
    reference = message.cameras.add()
    reference.CopyFrom(message.cameras[0])
    reference.camera, reference.time_offset, reference.clock_rate = "cam1", 0.0, 1.0
    message.reference_camera = "cam1"
    for found in message.cameras:
        state.handle(camera_info(found.camera), 0.0)
    state.handle(message, 0.0)
    file = tmp_path / "calibration.toml"
    file.write_text(calibration_file(state), encoding="utf-8")
    _, cameras = read_calibration(file)
    assert list(cameras) == [found.camera for found in message.cameras]
    first = message.cameras[0]
    assert cameras[first.camera].time_map.time_offset == first.time_offset
    assert cameras[first.camera].pose.translation == pytest.approx(np.array(first.translation))


def log_of(path: Path, seconds: int = 40) -> Path:
    with LogWriter(path) as log:
        log.write(CAMERA_INFO, "cam0", "local", camera_info("cam0"), 100 * SECOND)
        for index in range(seconds * 10):
            at = 100 * SECOND + index * SECOND // 10
            log.write(OBSERVATION, "cam0", "local", observation("cam0", index), at)
            if index == 50:
                log.write(CALIBRATION, "hub", "local", calibration(), at)
            if index > 50:
                point = track(index)
                point.reference_time_ns = index * SECOND // 10
                log.write(TRACK, "hub", "local", point, at)
    return path


def test_a_replay_can_seek_forward_and_back(tmp_path: Path) -> None:
    player = Player(LogRecording(log_of(tmp_path / "a.mcap")))
    assert player.duration == pytest.approx(39.9)
    assert player.state.solved is None
    player.seek_to = 30.0
    assert player.advance(0.1), "a seek makes a new state"
    camera = player.state.cameras["cam0"]
    assert camera.state(player.position) == "calibrated", "the calibration was published 25 s before"
    assert camera.fps(player.position) == pytest.approx(10.0, rel=0.05)
    path = player.state.paths["marker"].array()
    assert path[-1, 0] == pytest.approx(30.0, abs=0.11)
    assert not player.advance(1.0)
    assert player.position == pytest.approx(31.0)
    player.seek_to = 2.0
    player.advance(0.1)
    assert player.state.solved is None, "nothing was calibrated yet"
    assert player.state.cameras["cam0"].frames == 21
    player.speed = 1000.0
    player.advance(1.0)
    assert (player.position, player.playing) == (player.duration, False)


def test_a_refusal_in_a_log_does_not_remove_the_cameras(tmp_path: Path) -> None:
    refused = pb.Calibration(schema_version=1, status="refused", reason="nothing moved", revision=8)
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write(CAMERA_INFO, "cam0", "local", camera_info("cam0"), 0)
        log.write(CALIBRATION, "hub", "local", calibration(), SECOND)
        log.write(CALIBRATION, "hub", "local", refused, 2 * SECOND)
        log.write(OBSERVATION, "cam0", "local", observation("cam0"), 60 * SECOND)
    player = Player(LogRecording(tmp_path / "a.mcap"))
    player.seek(60.0)
    assert player.state.headline() == "refused: nothing moved"
    assert player.state.cameras["cam0"].pose is not None


def test_a_log_with_nothing_to_show_is_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap"):
        pass
    with pytest.raises(InputError, match="holds nothing to show"):
        LogRecording(tmp_path / "a.mcap")


def test_cameras_of_a_calibration_file_are_not_silent(tmp_path: Path) -> None:
    state = ViewState()
    message = calibration()
    for found in message.cameras:
        state.handle(camera_info(found.camera), 0.0)
    state.handle(message, 0.0)
    (tmp_path / "calibration.toml").write_text(calibration_file(state), encoding="utf-8")
    (tmp_path / "trajectory.csv").write_text("time,x,y,z,std\n5,1,2,3,0.1\n6,2,2,3,0.1\n", encoding="utf-8")
    player = Player(CalibrationRecording(tmp_path))
    player.advance(1.0)
    assert player.duration == 1.0
    assert {camera.state(player.position) for camera in player.state.cameras.values()} == {"calibrated"}
    assert player.state.paths["marker"].array()[:, 1].tolist() == [1.0, 2.0]
    (tmp_path / "trajectory.csv").write_text("time,x,y,z,std\n5,1,nan,3,0.1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"trajectory.csv:2: a number is not finite"):
        CalibrationRecording(tmp_path)


def test_a_click_ray_maps_to_its_pixel() -> None:
    origin = np.array([0.5, 0.1, -2.0])
    for index, u, v in ((0, 10.0, 20.0), (1, 630.0, 470.0)):
        aim = np.array([index * 1.06 + (u + 0.5) / 640 - 0.5, ((v + 0.5) / 480 - 0.5) * 0.75, 0.0])
        assert pixel_of(origin, aim - origin, index, (640, 480)) == pytest.approx((u, v))
    assert pixel_of(origin, np.array([1.0, 0.0, 0.0]), 0, (640, 480)) is None
    assert pixel_of(origin, np.array([5.0, 0.0, 1.0]), 0, (640, 480)) is None


def test_the_initial_viewpoint_shows_every_camera_and_the_path() -> None:
    """In a square window of 75 degrees, with a margin of a tenth."""
    generator = np.random.default_rng(5)
    for trial in range(50):
        up = np.eye(3)[trial % 3]
        points = generator.normal(0.0, [3.0, 1.0, 0.4], (int(generator.integers(2, 30)), 3)) + 7.0
        eye, middle = fit_viewpoint(points, up, 0.0)
        ahead = (middle - eye) / np.linalg.norm(middle - eye)
        across = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
        seen = points - eye
        depth = seen @ ahead
        assert depth.min() > 0.0
        places = np.column_stack([seen @ across, seen @ np.cross(across, ahead)]) / depth[:, None]
        edge = np.tan(np.radians(37.5))
        assert np.abs(places).max() == pytest.approx(0.9 * edge), "and no farther away than necessary"


def test_circles_mark_the_detections_of_the_images_own_frame() -> None:
    """The image is of frame 7; when it is drawn the marker has moved."""
    state = ViewState()
    state.handle(picture("cam0"), 0.0)
    state.handle(observation("cam0"), 0.0)
    later = observation("cam0", 1)
    later.detections[0].u = 900.0
    state.handle(later, 0.1)
    camera = state.cameras["cam0"]
    image = np.full((180, 320, 3), 128, dtype=np.uint8)
    drawn = draw_detections(image, camera)
    changed = np.argwhere((drawn != image).any(axis=2))
    # (320.5, 240.25) of 1280x720 is (80, 60) of 320x180.
    assert changed.mean(axis=0) == pytest.approx([60.2, 80.2], abs=0.7)
    assert (image == 128).all()


class Headers(dict):  # type: ignore[type-arg]
    """Headers as in websockets: by name, None where absent."""


@pytest.mark.parametrize(
    ("headers", "open_"),
    [
        ({"Host": "127.0.0.1:8080"}, True),
        ({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, True),
        ({"Host": "[::1]:8080"}, True),
        ({"Host": "127.0.0.1:8080", "Origin": "https://evil.example"}, False),
        ({"Host": "evil.example:8080"}, False),
        ({}, False),
    ],
)
def test_without_a_token_only_this_machine_and_this_page_have_access(headers: dict[str, str], open_: bool) -> None:
    assert AccessControl().allows("/", Headers(headers)) is open_


@pytest.mark.parametrize(
    ("path", "cookie", "open_"),
    [
        ("/?token=secret-secret", "", True),
        ("/?token=wrong-secret!", "", False),
        ("/", "", False),
        ("/", "syncline-view=secret-secret", True),
        ("/", "other=1; syncline-view=secret-secret", True),
        ("/", "syncline-view=", False),
        ("/?token=", "syncline-view=wrong", False),
    ],
)
def test_beyond_this_machine_the_token_is_required(path: str, cookie: str, open_: bool) -> None:
    assert AccessControl("secret-secret").allows(path, Headers({"Host": "rig.lan:8080", "Cookie": cookie})) is open_


def test_which_hosts_are_this_machine() -> None:
    assert all(is_local(host) for host in ("localhost", "127.0.0.1", "127.8.8.8", "::1"))
    assert not any(is_local(host) for host in ("0.0.0.0", "192.168.1.4", "localhost.evil.example", "", "::"))
