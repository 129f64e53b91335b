"""Rigs as folders: the shipped ones are complete, and errors in one are reported before anything starts."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from deploy.config.agents import CameraConfig, HubConfig
from deploy.config.file import load
from deploy.site.fleet import read_state
from deploy.site.rig_folder import SHIPPED, find_rig, read_rig_folder, write_agent_configs
from edge import scenes
from edge.scenes.common.base import rescale_intrinsics, rescale_scene
from protocols.core.errors import InputError
from protocols.session.rig import read_rig
from tests.support.command_line import refusal

RIGS = sorted(path.name for path in SHIPPED.iterdir() if path.is_dir())


def test_the_documented_rigs_are_shipped() -> None:
    assert {"webcams-room", "drone-cage", "oak-array", "companion"} <= set(RIGS)


@pytest.mark.parametrize("name", RIGS)
def test_a_shipped_rig_is_complete(name: str, tmp_path: Path) -> None:
    rig = read_rig_folder(find_rig(name))
    assert (SHIPPED / name / "README.md").read_text().startswith("# ")
    assert rig.of("camera") or rig.of("uav")
    agents = write_agent_configs(rig, tmp_path, simulated=True, endpoint="tcp/127.0.0.1:17447")
    assert [agent.name for agent in agents] == [agent.name for agent in rig.agents]
    for agent in agents:
        assert type(agent.config) is type(load(agent.file, type(agent.config)))
        if agent.role != "router":
            assert agent.config.bus.endpoints()[0] == ("tcp/127.0.0.1:17447",)
    cameras = [agent.config for agent in agents if agent.role == "camera"]
    assert all(config.driver == "simulated" and config.video is None and config.oak is None for config in cameras)
    assert len({config.simulated.camera for config in cameras}) == len(cameras)
    if rig.of("hub"):
        written = read_rig(tmp_path / "config" / "rig.toml")
        assert set(written.cameras) == {config.id for config in cameras}
        assert rig.rig is not None
        assert len(written.distances) == len(rig.rig.distances) > 0, "nothing makes the lengths metric"


def test_the_oak_array_matches_its_description() -> None:
    rig = read_rig_folder(find_rig("oak-array"))
    assert len(rig.of("camera")) == 20
    assert len(rig.of("hub")) == 2
    assert len(rig.of("router")) == 1
    assert len({agent.config.oak.device for agent in rig.of("camera")}) == 20


def test_distances_of_the_simulated_rig_are_true(tmp_path: Path) -> None:
    rig = read_rig_folder(find_rig("webcams-room"))
    write_agent_configs(rig, tmp_path, simulated=True, endpoint="tcp/127.0.0.1:17447")
    ((a, b, length),) = read_rig(tmp_path / "config" / "rig.toml").distances
    scene = scenes.get_marker_scene(rig.world.scene, rig.world.seed, 4)
    names = [agent.name for agent in rig.of("camera")]
    one, two = (scene.cameras[names.index(name)].pose.position for name in (a, b))
    assert length == pytest.approx(float(np.linalg.norm(one - two)), abs=1e-12)


def test_real_devices_keep_their_own_intrinsics_and_files(tmp_path: Path) -> None:
    rig = read_rig_folder(find_rig("webcams-room"))
    agents = {agent.name: agent for agent in write_agent_configs(rig, tmp_path, simulated=False, endpoint=None)}
    camera, hub = agents["cam0"].config, agents["hub"].config
    assert isinstance(camera, CameraConfig)
    assert camera.driver == "video"
    assert camera.rig is not None
    assert read_rig(camera.rig).cameras.keys() == {"cam0", "cam1", "cam2", "cam3"}
    assert isinstance(hub, HubConfig)
    assert hub.out == tmp_path.resolve() / "hub", "a shipped rig's folder is no place for results"


@pytest.mark.parametrize(
    ("file", "text", "expected_text"),
    [
        ("cam1.toml", 'id = "cam0"\n', "is also that of cam0.toml"),
        ("cam1.toml", 'id = "cam1"\nsite = "elsewhere"\n', "several sites"),
        ("hub.toml", "window = 3\n", "did you mean window_s"),
        ("fleet.toml", "[simulated]\nwidht = 3\n", "did you mean width"),
        ("cam1.toml", 'id = "cam1"\nrig = "rig.toml"\n', "has no camera 'cam1'"),
    ],
)
def test_a_bad_rig_is_refused(tmp_path: Path, file: str, text: str, expected_text: str) -> None:
    (tmp_path / "cam0.toml").write_text('id = "cam0"\n')
    (tmp_path / "rig.toml").write_text('[cam0]\nname = "cam0"\nsize = [64, 48]\n')
    (tmp_path / file).write_text(text)
    with pytest.raises(InputError, match=expected_text):
        read_rig_folder(tmp_path)


def test_no_rig_and_no_agents(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected_text in (
        (["fleet", "up", "no-such-rig"], "webcams-room"),
        (["fleet", "up", str(tmp_path)], "no agents in this rig"),
        (["fleet", "up"], "needs a rig"),
        (["fleet", "up", "webcams-room", "--seconds", "-3"], "out of range"),
        (["fleet", "status", "--out", str(tmp_path)], "no fleet was started here"),
        (["fleet", "down", "--out", str(tmp_path)], "no fleet was started here"),
        (["fleet", "down", "webcams-room"], "takes only"),
    ):
        assert expected_text in refusal(capsys, arguments)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"pid": "x", "started": 1, "agents": {}}', '{"pid": 1, "agents": 3}']
)
def test_a_corrupt_state_file_is_ignored(tmp_path: Path, text: str) -> None:
    (tmp_path / "fleet.json").write_text(text)
    assert read_state(tmp_path) is None


def test_scaled_intrinsics_keep_the_viewing_directions() -> None:
    lens = scenes.get_marker_scene("marker", 3, 2).cameras[0].intrinsics
    small = rescale_intrinsics(lens, 160)
    assert (small.width, small.height) == (160, 120)
    corners = np.array([[-0.5, -0.5], [lens.width - 0.5, lens.height - 0.5]])
    shrunk = np.array([[-0.5, -0.5], [159.5, 119.5]])
    assert np.allclose(lens.unproject(corners), small.unproject(shrunk), atol=1e-9)


def test_a_lower_frame_rate_keeps_the_same_motion() -> None:
    scene = scenes.get_marker_scene("marker", 3, 2)
    slow = rescale_scene(scene, fps=5.0)
    assert [camera.fps for camera in slow.cameras] == [5.0, 5.0]
    assert slow.cameras[1].pose is scene.cameras[1].pose
    assert scene.cameras[0].fps == 30.0


def test_configurations_are_plain_toml() -> None:
    for file in sorted(SHIPPED.rglob("*.toml")):
        assert tomllib.loads(file.read_text(encoding="utf-8")), file
