"""The view server: access control, rendering and commands, without a browser."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser")

from hub.view.player import LogRecording, Player
from hub.view.server import ViewServer, run_view
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CALIBRATION, CAMERA_INFO, COMMAND, OBSERVATION, STATUS, TRACK
from tests.support.command_line import refusal
from tests.support.crowds import write_calibration
from tests.support.samples import MATRIX, camera_info, eventually, observation, status, track
from tests.support.threads import running
from tests.unit.hub.view.test_state import log_of

TOKEN = "a-long-secret-token"


@pytest.fixture
def view() -> Iterator[ViewServer]:
    server = ViewServer(port=0)
    yield server
    server.close()


def fetch(port: int, path: str = "/", **headers: str) -> tuple[int, dict[str, str]]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, {key.lower(): value for key, value in answer.headers.items()}
    except urllib.error.HTTPError as error:
        return error.code, {}


def test_on_loopback_the_page_opens_but_not_for_other_names(view: ViewServer) -> None:
    assert view.address == f"http://127.0.0.1:{view.port}/"
    code, headers = fetch(view.port)
    assert code == 200
    assert headers["x-frame-options"] == "DENY"
    assert fetch(view.port, Host="evil.example")[0] == 403
    assert fetch(view.port, Origin="https://evil.example")[0] == 403


def test_with_a_token_requests_without_it_are_refused() -> None:
    view = ViewServer(port=0, token=TOKEN)
    try:
        assert view.address.endswith(f"?token={TOKEN}")
        assert fetch(view.port)[0] == 403
        assert fetch(view.port, "/?token=wrong")[0] == 403
        assert fetch(view.port, "/index.html")[0] == 403
        code, headers = fetch(view.port, f"/?token={TOKEN}")
        assert code == 200
        cookie = headers["set-cookie"].split(";")[0]
        assert "HttpOnly" in headers["set-cookie"]
        assert fetch(view.port, Cookie=cookie)[0] == 200
    finally:
        view.close()


@pytest.mark.parametrize(("credential", "welcome"), [("", False), (f"syncline-view={TOKEN}", True)])
def test_the_web_socket_requires_the_token_too(credential: str, welcome: bool) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    view = ViewServer(port=0, token=TOKEN)
    headers = {"Cookie": credential} if credential else {}
    protocols = [f"viser-v{viser.__version__}"]
    try:
        address = f"ws://127.0.0.1:{view.port}"
        if welcome:
            with connect(address, additional_headers=headers, subprotocols=protocols) as socket:  # type: ignore[arg-type]
                assert socket.recv(10)
        else:
            with pytest.raises(InvalidStatus, match="403"):
                connect(address, additional_headers=headers, subprotocols=protocols)  # type: ignore[arg-type]
            assert view.access.refused == 1
    finally:
        view.close()


def test_beyond_loopback_there_is_always_a_token() -> None:
    view = ViewServer("0.0.0.0", 0)
    try:
        assert len(view.access.token) >= 20
        assert fetch(view.port)[0] == 403
    finally:
        view.close()


def test_a_taken_port_is_reported(view: ViewServer) -> None:
    with pytest.raises(InputError, match=f"port {view.port} is taken; give --port another"):
        ViewServer(port=view.port)


def solved(*places: tuple[float, float, float], revision: int = 1) -> pb.Calibration:
    message = pb.Calibration(
        schema_version=1,
        revision=revision,
        status="solved",
        reference_camera="cam0",
        scale="metric",
        units="m",
        solver="joint",
    )
    for index, place in enumerate(places):
        message.cameras.append(
            pb.CameraCalibration(
                camera=f"cam{index}",
                rotation=[0.0, 0.0, 0.0],
                translation=[-value for value in place],
                clock_rate=1.0,
                time_offset=0.25 * index,
                time_offset_std=1e-4 * index,
                position_std=[0.01, 0.01, 0.02],
                rms_px=0.4,
                matrix=MATRIX,
                distortions=[0.0] * 5,
            )
        )
    return message


def test_frusta_follow_the_published_calibration(view: ViewServer) -> None:
    network = MemoryHub()
    with MemoryBus(network) as agents, MemoryBus(network) as bus, running(lambda stop: run_view(bus, view, stop)):
        assert eventually(lambda: len(network.subscriptions) >= 5)
        for name in ("cam0", "cam1"):
            agents.publisher(CAMERA_INFO, name).put(camera_info(name))
            agents.publisher(OBSERVATION, name).put(observation(name))
        hub = agents.publisher(CALIBRATION, "hub")
        hub.put(solved((0, 0, 0), (1, 0, 0)))
        assert eventually(lambda: len(view.scene._frusta) == 2)
        assert eventually(lambda: np.allclose(view.scene._frusta["cam1"].position, [1, 0, 0]))
        hub.put(solved((0, 0, 0), (1, 2, 0), revision=2))
        assert eventually(lambda: np.allclose(view.scene._frusta["cam1"].position, [1, 2, 0]))
        agents.publisher(TRACK, "hub").put(track())
        assert eventually(lambda: "/paths/0/head" in view.scene._paths)
        assert eventually(lambda: np.allclose(view.scene._paths["/paths/0/head"].position, [1, 2, 3]))
        # A camera that is missing in the next calibration is removed.
        hub.put(solved((0, 0, 0), revision=3))
        assert eventually(lambda: list(view.scene._frusta) == ["cam0"])


def test_a_click_sends_a_command_to_the_running_hub(view: ViewServer) -> None:
    network = MemoryHub()
    with MemoryBus(network) as agents, MemoryBus(network) as bus:
        subscription = agents.subscribe(COMMAND)
        with running(lambda stop: run_view(bus, view, stop)):
            message = status("hub")
            message.role, message.boot_id = "hub", "boot-7"
            assert eventually(lambda: len(network.subscriptions) >= 6)
            agents.publisher(STATUS, "hub").put(message)
            view.page.requested_actions.append("recalibrate")
            received = []

            def came() -> bool:
                received.extend(subscription.drain())
                if not received:
                    view.page.requested_actions.append("recalibrate")  # the status may come after the click
                return bool(received)

            assert eventually(came)
            command = received[0].message
            assert isinstance(command, pb.Command)
            assert (command.action, command.agent, command.agent_boot) == ("recalibrate", "hub", "boot-7")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nowhere.mcap"], "there is no such file or folder; name a log"),
        (["empty"], "neither a log nor a calibration; name a .mcap log"),
        (["--port", "99999"], "--port 99999 is out of range"),
        (["--token", "short"], "--token is too short"),
        (["--token", "with a space in it"], "may not stand in an address"),
        (["--listen", "203.0.113.77"], "cannot listen on 203.0.113.77"),
        (["--connect", "nonsense"], "is not an endpoint"),
        (["--rerun", "a.rrd"], "--rerun goes with a log"),
        (["known.toml", "--connect", "tcp/127.0.0.1:7447"], "--connect goes with the bus, not with a recording"),
    ],
)
def test_bad_arguments_are_reported_in_one_line(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("deploy.agents.processes.stop_on_signals", threading.Event)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    write_calibration(tmp_path / "known.toml")  # was taken for an agent's file, and the live bus shown
    assert expected in refusal(capsys, ["view", *arguments])


def test_a_position_that_the_user_chose_is_not_overwritten_before_it_is_read(tmp_path: Path) -> None:
    player = Player(LogRecording(log_of(tmp_path / "a.mcap")))
    view = ViewServer(port=0, player=player)
    try:
        player.advance(3.0)
        view.page._show_time(player)
        assert view.page._time.value == 3.0, "the slider follows the playback"
        view.page._time.value = 20.0  # as viser does on the browser's message; the callback comes later
        view.page._show_time(player)
        assert view.page._time.value == player.seek_to == 20.0
        player.advance(0.0)
        player.advance(2.0)
        view.page._show_time(player)
        assert view.page._time.value == 22.0, "and follows it again after the seek"
    finally:
        view.close()
