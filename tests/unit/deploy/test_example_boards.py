"""The shipped configurations of boards, the devices and detectors made from them, and blur detection."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import deploy
from deploy.agents.assembly import _detector as detector_of
from deploy.agents.assembly import _target as target_of
from deploy.agents.assembly import make_device
from deploy.commands.agents.run import camera
from deploy.config.agents import CameraConfig
from deploy.config.file import effective_toml, load
from edge import scenes
from edge.agents.image_health import ImageHealth
from edge.detectors.marker.ball import MarkerDetector
from edge.detectors.marker.bright import BrightDetector
from edge.detectors.marker.tag import TagDetector
from edge.devices.base import Frame
from edge.scenes import renderer_for
from protocols.core.errors import InputError

BOARDS = sorted((Path(deploy.__file__).parent / "examples" / "boards").glob("*.toml"))
DRIVERS = {
    "oak": "OakCamera",
    "usb": "UsbCamera",
    "rtsp": "NetworkCamera",
    "picamera2": "PiCamera",
    "video": "VideoPlayback",
    "log": "LogPlayback",
}


def test_every_board_of_the_readme_has_an_example() -> None:
    assert [file.stem for file in BOARDS] == ["gopro-file", "ip-camera", "logged", "oak", "pi-camera", "usb-webcam"]


@pytest.mark.parametrize("file", BOARDS, ids=lambda file: file.stem)
def test_an_example_is_read_and_its_driver_constructed(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("linuxpy")
    config = load(file, CameraConfig)
    assert type(make_device(config, None)).__name__ == DRIVERS[config.driver]
    assert camera(file, print_config=True) == 0
    (tmp_path / file.name).write_text(capsys.readouterr().out)
    assert effective_toml(load(tmp_path / file.name, CameraConfig)) == effective_toml(config)


@pytest.mark.parametrize(
    ("mode", "kind", "target"),
    [("colour", MarkerDetector, "ball"), ("bright", BrightDetector, "light"), ("tag", TagDetector, "tag")],
)
def test_the_markers_mode_chooses_its_detector(mode: str, kind: type, target: str, tmp_path: Path) -> None:
    file = tmp_path / "cam.toml"
    file.write_text(f'id = "a"\n[marker]\nmode = "{mode}"\n')
    config = load(file, CameraConfig)
    assert isinstance(detector_of(config, None, 30.0), kind)
    assert target_of(config) == target
    file.write_text('id = "a"\ndetector = "person"\n')
    assert target_of(load(file, CameraConfig)) == "person"


@pytest.mark.parametrize(
    ("text", "expected_text"),
    [
        ('driver = "rtsp"', "needs an [rtsp] table"),
        ('driver = "rtsp"\n[rtsp]\nurl = "camera"', "rtsp.url"),
        ('driver = "log"', "needs a [log] table"),
        ('driver = "log"\n[log]\nfile = "a.mcap"\nrate = 2', "log.rate"),
        ('driver = "usb"\n[usb]\npixels = "H264"', "use one of"),
        ('driver = "picamera2"\n[picamera2]\nexposure_us = 0', "picamera2.exposure_us"),
        ('driver = "oak"\n[oak]\nlabels = ["person"]', "give its archive as nn"),
        ('driver = "oak"\n[oak]\nnn = "a.tar.xz"\nconfidence = 2', "oak.confidence"),
        ('[marker]\nmode = "bright"\nthreshold = 255', "marker.threshold"),
    ],
)
def test_mistakes_are_reported(text: str, expected_text: str, tmp_path: Path) -> None:
    file = tmp_path / "cam.toml"
    file.write_text(f'id = "a"\n{text}\n')
    with pytest.raises(InputError) as error:
        load(file, CameraConfig)
    assert expected_text in str(error.value)


def watched(pictures: list[np.ndarray], hz: float = 30.0) -> list[tuple[float, str]]:
    """The reported problem after each image, with its time."""
    watch = ImageHealth(live=True, period_s=1.0 / hz)
    watch.start(0.0)
    reported = []
    for index, image in enumerate(pictures):
        now = index / hz
        frame = Frame(image, round(now * 1e9), index)
        watch.accept(frame, now)
        watch.measure_sharpness(frame, now)
        reported.append((now, watch.problem(now)))
    return reported


def test_loss_of_focus_is_reported_within_two_seconds_and_a_sharp_camera_is_not() -> None:
    scene = scenes.get_marker_scene("marker", 0)
    renderer = renderer_for(scene, "cam0", np.random.default_rng(0))
    sharp = [renderer.render(1.0 + index / 30.0) for index in range(40)]
    rng = np.random.default_rng(1)

    def unfocused(image: np.ndarray) -> np.ndarray:
        soft = cv2.GaussianBlur(image, (0, 0), 4.0) + rng.normal(0.0, 3.0, image.shape)
        return np.clip(soft, 0, 255).astype(np.uint8)

    reported = watched(sharp + [unfocused(image) for image in sharp + sharp] + sharp)
    first = next(now for now, text in reported if text.startswith("blurred for"))
    assert 40 / 30 < first <= 40 / 30 + 2.0
    assert not any(text for now, text in reported if now <= 40 / 30)
    assert reported[-1][1] == "", "in focus again"


def test_dim_light_noise_and_water_are_not_reported_as_blur() -> None:
    scene = scenes.get_marker_scene("marker", 1)
    renderer = renderer_for(scene, "cam0", np.random.default_rng(0))
    frames = [renderer.render(1.0 + index / 30.0) for index in range(30)]
    darker = [np.asarray(frame * 0.4, dtype=np.uint8) for frame in frames]
    assert not any(text for _, text in watched(frames + darker * 2))
    rng = np.random.default_rng(2)
    noise = [rng.integers(40, 200, (48, 64, 3), dtype=np.uint8) for _ in range(90)]
    assert not any(text for _, text in watched(noise))


@pytest.mark.parametrize(
    "text", ['detector = "person"', 'detector = "vehicle"', 'driver = "oak"\n[oak]\nnn = "a.tar.xz"']
)
def test_a_package_missing_from_a_boards_bundle_is_reported(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "cam.toml"
    file.write_text(f'id = "a"\n{text}\n')
    monkeypatch.setattr("deploy.agents.assembly.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"needs SciPy.*--extra scipy"):
        detector_of(load(file, CameraConfig), None, 30.0)


def test_a_network_of_a_camera_is_beside_its_configuration(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="the extra `onnx` is not installed")
    from edge.detectors.network.detector import NetworkDetector
    from tests.support.networks import constant_model, write_network

    write_network(tmp_path, constant_model({"o": [[[9.0, 9.0, 30.0, 40.0, 0.9, 0.0]]]}), 'layout = "end2end"')
    file = tmp_path / "cam.toml"
    file.write_text('id = "cam7"\ndetector = "model.toml"\n')
    config = load(file, CameraConfig)
    assert str(tmp_path / "model.toml") in effective_toml(config)
    detector = detector_of(config, None, 30.0)
    assert isinstance(detector, NetworkDetector)
    assert detector.detect(np.zeros((48, 64, 3), np.uint8))[0].label == "cam7-p0"
    file.write_text('id = "cam7"\ndetector = "none.toml"\n')
    with pytest.raises(InputError, match=r"none\.toml"):
        detector_of(load(file, CameraConfig), None, 30.0)
