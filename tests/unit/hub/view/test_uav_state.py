"""Drones in the view: association of messages with images, the overlay and the panel, without a browser."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hub.view.player import LogRecording, Player
from hub.view.scene_renderer import decode_rgb
from hub.view.state import ViewState
from hub.view.uav_overlay import UavView, draw_uav, pad_to_aspect, uav_panel_html
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import FLIGHT_IMAGE, TARGET, UAV_INFO
from tests.support.samples import flight_image, observation, picture, road_map, target_cloud, target_state, uav_info

SECOND = 1_000_000_000
GREY = np.full((240, 320, 3), 128, np.uint8)
_WIDTH, _PICTURE = 720, 720 / 1.7  # of the canvas, and of the picture in its middle


def flying(state: str, centre: list[float], frame: int = 7) -> UavView:
    """A drone with one thumbnail of a 640x480 camera and one target state."""
    flight = UavView("drone")
    flight.handle(uav_info("drone"), 0.0)
    target = target_state("drone")
    target.frame, target.state, target.centre[:] = frame, state, centre
    target.size[:], target.std_px = [40.0, 20.0], 12.0
    flight.handle(target, 0.0)
    shown = picture("drone")
    shown.frame, shown.width, shown.height = 7, 640, 480
    flight.show_thumbnail(shown, 0.0)
    return flight


def colour_at(image: np.ndarray, u: float, v: float) -> np.ndarray:
    """Colours (n, 3) around a pixel of the 640x480 image."""
    scale = _PICTURE / 640
    x, y = round((u + 0.5 + 0.35 * 640) * scale - 0.5), round((v + 0.5 + 0.35 * 480) * scale - 0.5)
    return np.asarray(image[y - 3 : y + 4, x - 3 : x + 4].reshape(-1, 3))


def is_like(colours: np.ndarray, wanted: tuple[int, int, int]) -> bool:
    return bool((np.abs(colours.astype(int) - wanted).max(axis=1) < 40).any())


@pytest.mark.parametrize(("state", "colour"), [("visible", (90, 220, 90)), ("coasting", (255, 175, 50))])
@pytest.mark.parametrize("centre", [[100.0, 200.0], [-100.0, 200.0], [320.0, 560.0]])
def test_the_estimate_is_drawn_inside_and_outside_the_image(
    state: str, colour: tuple[int, int, int], centre: list[float]
) -> None:
    image = draw_uav(flying(state, centre), GREY)
    assert image.shape == (540, _WIDTH, 3)
    assert is_like(colour_at(image, centre[0] - 20.0, centre[1]), colour), "the left side of its box"
    assert not is_like(colour_at(image, 400.0, 100.0), colour)


def test_an_arrow_points_to_an_estimate_far_outside() -> None:
    image = draw_uav(flying("coasting", [5000.0, 240.0]), GREY)
    orange = np.argwhere((np.abs(image.astype(int) - (255, 175, 50)).max(axis=2)) < 30)
    assert len(orange) > 20
    assert orange[:, 1].min() > _WIDTH - 60, "at the right edge"
    assert orange[:, 0].mean() == pytest.approx(270, abs=15)


def test_lost_targets_and_nan_estimates_are_not_drawn() -> None:
    empty = draw_uav(flying("lost", []), GREY)
    assert not is_like(empty.reshape(-1, 3), (255, 175, 50))
    assert not is_like(empty.reshape(-1, 3), (235, 70, 60))
    odd = draw_uav(flying("visible", [float("nan"), float("inf")]), GREY)
    assert odd.shape == empty.shape


def test_road_and_particles_are_drawn_at_their_pixels() -> None:
    flight = flying("coasting", [300.0, -60.0])
    cloud, road = target_cloud("drone"), road_map("drone")
    cloud.frame = road.frame = 7
    cloud.pixels[:], road.pixels[:] = [300.0, -100.0, 700.0, 100.0], [-50.0, 240.0]
    flight.handle(cloud, 0.0)
    flight.handle(road, 0.0)
    image = draw_uav(flight, GREY)
    assert is_like(colour_at(image, 300.0, -100.0), (240, 150, 220))
    assert is_like(colour_at(image, 700.0, 100.0), (240, 150, 220))
    assert is_like(colour_at(image, -50.0, 240.0), (120, 160, 210))


def test_messages_belong_to_the_images_own_frame() -> None:
    """Images come twice a second and late; estimates thirty times a second."""
    flight = UavView("drone")
    for frame in range(10):
        target = target_state("drone", frame)
        target.frame, target.centre[:] = frame, [10.0 * frame, 0.0]
        flight.handle(target, 0.0)
    shown = picture("drone")
    shown.frame = 4
    flight.show_thumbnail(shown, 0.0)
    target_then, _, _ = flight.at_image()
    assert target_then is not None
    assert target_then.centre[0] == 40.0
    restarted = target_state("drone")
    restarted.boot_id, restarted.frame = "boot-2", 0
    flight.handle(restarted, 1.0)
    assert [one.boot_id for one in flight.targets] == ["boot-2"], "messages of another boot id are dropped"


def test_the_panel_shows_state_position_and_uncertainty() -> None:
    text = uav_panel_html(flying("coasting", [-20.5, 700.0]), 1.0)
    assert "… coasting, below and left of the picture" in text
    assert "± 12 px" in text
    assert "± 1.2 m on the ground" in text
    assert "30 km/h" in text
    assert "data-target='coasting'" in text
    assert "✓ visible" in uav_panel_html(flying("visible", [100.0, 100.0]), 1.0)
    assert "picture 9 s old" in uav_panel_html(flying("visible", [100.0, 100.0]), 9.0)
    assert "no target" in uav_panel_html(UavView("<b>"), 0.0)
    assert "<b>:" not in uav_panel_html(UavView("<b>"), 0.0), "a name is escaped"


def test_a_drone_is_not_shown_as_a_silent_camera() -> None:
    state = ViewState()
    early = picture("drone")
    state.handle(early, 0.0)
    state.handle(uav_info("drone"), 0.1)
    state.handle(observation("cam0"), 0.1)
    assert (list(state.cameras), list(state.uavs)) == (["cam0"], ["drone"])
    assert state.uavs["drone"].picture is early
    state.presence("uav", "drone", alive=False, boot="boot-1")
    assert state.uavs == {}


def test_a_flight_plays_back_with_full_resolution_images(tmp_path: Path) -> None:
    good, data = cv2.imencode(".jpg", np.full((480, 640, 3), 90, np.uint8))
    assert good
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.write(UAV_INFO, "drone", "local", uav_info("drone"), 5 * SECOND)
        for index in range(100):
            shown, target = flight_image("drone", index), target_state("drone", index)
            shown.frame = target.frame = index
            shown.jpeg = data.tobytes()
            at = 5 * SECOND + index * SECOND // 10
            log.write(FLIGHT_IMAGE, "drone", "local", shown, at)
            log.write(TARGET, "drone", "local", target, at)
    player = Player(LogRecording(path))
    assert player.duration == pytest.approx(9.9)
    for wanted in (6.0, 3.0):
        player.seek_to = wanted
        assert player.advance(0.1)
        flight = player.state.uavs["drone"]
        target_then, _, _ = flight.at_image()
        assert target_then is not None
        assert flight.picture is not None
        assert flight.picture.frame == target_then.frame == round(10 * wanted)
        assert flight.picture.jpeg == data.tobytes()
    assert player.state.headline() == "1 drone"


def test_padding_keeps_the_aspect_of_the_image() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    image[:] = (9, 8, 7)
    for aspect in (1.0, 2.0, 3.5):
        out = pad_to_aspect(image, aspect)
        assert out.shape[1] / out.shape[0] == pytest.approx(aspect, rel=0.01)
        assert ((out == (9, 8, 7)).all(axis=2)).sum() == 100 * 200
    assert pad_to_aspect(image, float("nan")).shape == image.shape


def test_a_target_without_an_image_is_shown() -> None:
    flight = UavView("drone")
    flight.handle(pb.TargetState(agent="drone", boot_id="b", state="visible", centre=[10.0, 10.0], std_px=2.0), 0.0)
    assert draw_uav(flight, None).shape[1] == _WIDTH
    assert "no picture yet" in uav_panel_html(flight, 0.0)


@pytest.mark.parametrize("size", [(1, 65_535), (65_535, 1), (1, 1), (480, 640)])
def test_extreme_aspect_ratios_keep_the_canvas_bounded(size: tuple[int, int]) -> None:
    flight = flying("coasting", [-100.0, 200.0])
    assert flight.picture is not None
    flight.picture.width, flight.picture.height = size
    for shown in (GREY, None):
        image = draw_uav(flight, shown)
        assert image.shape[1] == _WIDTH
        assert 2 <= image.shape[0] <= 3 * _WIDTH


def test_an_image_with_an_enormous_size_is_not_decoded() -> None:
    good, data = cv2.imencode(".jpg", GREY)
    assert good
    real = data.tobytes()
    place = real.index(b"\xff\xc0") + 5
    assert decode_rgb(real) is not None
    assert decode_rgb(real[:place] + (65_000).to_bytes(2, "big") * 2 + real[place + 4 :]) is None
    assert decode_rgb(b"") is None
    assert decode_rgb(b"no picture") is None
