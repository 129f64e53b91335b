"""Configurations are read strictly, and every mistake is reported with file, line and remedy."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig
from deploy.config.file import effective_toml, load
from protocols.bus.settings import LOOPBACK_ROUTER, BusConfig, is_loopback
from protocols.core.errors import InputError


def write(folder: Path, text: str) -> Path:
    path = folder / "agent.toml"
    path.write_text(text, encoding="utf-8")
    return path


CAMERA = """
site = "yard"
id = "cam0"
rig = "../rig.toml"
driver = "video"

[bus]
mode = "client"
connect = ["tcp/192.168.1.5:7447"]

[video]
source = "clips/a.mp4"
fps = 30

[marker]
colour = [255, 128, 0]
"""


def test_a_camera_configuration_is_read(tmp_path: Path) -> None:
    config = load(write(tmp_path, CAMERA), CameraConfig)
    assert (config.site, config.id, config.driver) == ("yard", "cam0", "video")
    assert config.bus == BusConfig(mode="client", connect=("tcp/192.168.1.5:7447",))
    assert config.marker.colour == (255, 128, 0)
    assert config.video is not None
    assert config.video.fps == 30.0


def test_paths_are_taken_from_the_folder_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, CAMERA)
    monkeypatch.chdir(tmp_path)
    config = load("agent.toml", CameraConfig)
    assert config.rig == tmp_path / "../rig.toml"
    assert config.video is not None
    assert config.video.source == str(tmp_path / "clips/a.mp4")
    assert load(write(tmp_path, 'out = "/var/a.mcap"'), RecorderConfig).out == Path("/var/a.mcap")


@pytest.mark.parametrize("source", ["rtsp://10.0.0.7/stream", "0", "/dev/video2"])
def test_a_source_that_is_no_relative_file_stays_as_it_is(tmp_path: Path, source: str) -> None:
    text = f'id = "cam0"\ndriver = "video"\n[video]\nsource = "{source}"'
    config = load(write(tmp_path, text), CameraConfig)
    assert config.video is not None
    assert config.video.source == source


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (CAMERA, CameraConfig),
        ('id = "a"\n[simulated]\nduration_s = 5', CameraConfig),
        ("", HubConfig),
        ('rig = "r.toml"\nout = "o"', HubConfig),
        ('[bus]\nlisten = ["tcp/0.0.0.0:7447"]\nmode = "router"', RecorderConfig),
    ],
)
def test_the_effective_configuration_reads_back_to_the_same(
    tmp_path: Path, text: str, kind: type[msgspec.Struct]
) -> None:
    config = load(write(tmp_path, text), kind)
    printed = effective_toml(config)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    # A path that was left to its default is the one thing that depends on where the file lies.
    if kind is not RecorderConfig:
        assert load(write(elsewhere, printed), kind) == config
    assert load(write(tmp_path, printed), kind) == msgspec.structs.replace(config, **_resolved(config, tmp_path))


def _resolved(config: msgspec.Struct, folder: Path) -> dict[str, Path]:
    return {"out": folder / config.out} if isinstance(config, RecorderConfig) else {}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('id = "a"\n\nbos = 1', "agent.toml:3: unknown key bos; did you mean bus?"),
        (
            'id = "a"\n[bus]\nlisten = []\nconect = []',
            "agent.toml:4: unknown key bus.conect; did you mean connect?",
        ),
        (
            'id = "a"\n[marker]\nshape = "ball"',
            "agent.toml:3: unknown key marker.shape; use one of label, mode, colour",
        ),
        ('id = "a"\n[bus]\nmode = "mesh"', "invalid enum value 'mesh'; use one of peer, client, router"),
        ('site = "x"', "agent.toml: id is missing; add id = …"),
        ('id = "Cam/1"', "agent.toml:1: id 'Cam/1' is not usable: it has a character that is not allowed ('/')"),
        ('id = "a"\nsite = "a/b"', "agent.toml:2: site 'a/b' is not usable"),
        ('id = "a"\ndriver = "video"', 'agent.toml:2: driver = "video" needs a [video] table'),
        ('id = "a"\ndriver = "video"\n[video]\nfps = 3', "agent.toml:3: source is missing in [video]"),
        ('id = "a"\n[simulated]\nseed = "x"', "agent.toml:3: simulated.seed: expected int, got str"),
        ('id = "a"\n[simulated]\nduration_s = inf', "agent.toml:3: simulated.duration_s is not finite"),
        ('id = "a"\n[marker]\ncolour = [1, 2, 300]', "agent.toml:3: marker.colour[2]: expected int <= 255"),
        (
            'id = "a"\n[bus]\nconnect = ["10.0.0.1"]',
            "agent.toml:2: bus: '10.0.0.1' is not an endpoint; write it like",
        ),
        (
            'id = "a"\n[bus]\nconnect = ["tcp/10.0.0.1:7447"]',
            'set listen, e.g. ["tcp/192.168.1.20:7447"], or mode',
        ),
        ('id = "a"\nrig = 3', "agent.toml:2: rig: expected"),
        ('id = "a"\nrig = ""', "agent.toml:2: rig: expected a text that is not empty"),
        ('id = "a"\nid = "b"', "agent.toml:2: not valid TOML: Cannot overwrite a value"),
        ('id = "a', "agent.toml:1: not valid TOML"),
    ],
)
def test_a_mistake_is_reported_with_its_line_and_a_remedy(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as error:
        load(write(tmp_path, text), CameraConfig)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
    assert error.value.exit_status == 2


def test_a_file_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: this configuration does not exist"):
        load(tmp_path / "none.toml", HubConfig)
    (tmp_path / "latin.toml").write_bytes(b'id = "\xe9"')
    with pytest.raises(InputError, match="it is not UTF-8"):
        load(tmp_path / "latin.toml", HubConfig)


def test_by_default_nothing_leaves_this_machine() -> None:
    for mode in ("peer", "client", "router"):
        connect, listen = BusConfig(mode=mode).endpoints()  # type: ignore[arg-type]
        assert connect + listen
        assert all(is_loopback(endpoint) for endpoint in connect + listen)
    assert BusConfig().endpoints()[0] == (LOOPBACK_ROUTER,)
    assert BusConfig().multicast is False
    assert not is_loopback("tcp/10.0.0.1:1")
    assert not is_loopback("tcp/[::]:0")


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "tcp",
        "tcp/",
        "tcp/localhost",
        "tcp/localhost:port",
        "tcp/h:70000",
        "tcp/h:0",
        "foo/h:1",
        "tcp/a b:1",
    ],
)
def test_an_endpoint_that_would_be_retried_forever_is_refused(endpoint: str) -> None:
    with pytest.raises(InputError, match="is not an endpoint; write it like"):
        BusConfig(mode="client", connect=(endpoint,)).endpoints()


def test_a_client_that_should_listen_is_refused() -> None:
    with pytest.raises(InputError, match="a client cannot listen"):
        BusConfig(mode="client", listen=(LOOPBACK_ROUTER,)).endpoints()
