"""Ground stations as real processes, MAVSDK's servers and MAVProxy, at a simulated autopilot with a camera behind it.

`make faults` installs them into the folder `stations` of its environment. Where they cannot be had, these tests are
skipped.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("pymavlink")
from deploy.agents.processes import free_udp_port
from edge.mavlink.dialect import mavlink as M
from edge.mavlink.link.transport import Udp, Url
from edge.mavlink.roles.camera import SelectTarget
from protocols.bus.router.zenoh_router import free_endpoint
from tests.faults.stations import STATIONS, exchanged
from tests.support.vehicle_link import autopilot, camera_on

SERVERS = {"MAVSDK 3": "mavsdk", "MAVSDK 4": "mavsdk_grpc"}
MAVPROXY = STATIONS / "bin" / "mavproxy.py"


@contextmanager
def process(*command: str, folder: Path) -> Iterator[None]:
    environment = {**os.environ, "PYTHONPATH": str(STATIONS), "MAVLINK20": "1", "MPLCONFIGDIR": str(folder)}
    running = subprocess.Popen(
        command, env=environment, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        running.terminate()
        try:
            running.wait(3.0)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()


async def dialogue(client: str, port: int) -> None:
    """What an application with MAVSDK does with a camera, through the server of either version."""
    import mavsdk_grpc as mavsdk

    drone = mavsdk.System(mavsdk_server_address="127.0.0.1", port=port)
    await drone.connect()
    async for cameras in drone.camera.camera_list():
        if cameras.cameras:
            camera = cameras.cameras[0].component_id
            exchanged(client, "camera list", cameras.cameras[0].model_name)
            break
    uri = ""
    while not uri:  # MAVSDK asks for it some seconds after the camera's information
        uri = (await drone.camera.get_video_stream_info(camera)).settings.uri
        await asyncio.sleep(0.1)
    exchanged(client, "video stream address", uri)
    texts: list[str] = []

    async def read_texts() -> None:
        async for text in drone.telemetry.status_text():
            texts.append(text.text)

    reading = asyncio.create_task(read_texts())
    await asyncio.sleep(1.0)
    for step, parameters in (
        ("start_video_streaming", (1,)),
        ("track_rectangle", (0.1, 0.2, 0.3, 0.4)),
        ("track_point", (0.5, 0.25, 0.1)),
        ("track_stop", ()),
        ("stop_video_streaming", (1,)),
        ("start_video_streaming", (7,)),
    ):
        try:
            await getattr(drone.camera, step)(camera, *parameters)
            result = "SUCCESS"
        except mavsdk.camera.CameraError as error:
            result = str(error).partition(":")[0]
        exchanged(client, f"{step}({', '.join(map(str, parameters))})", result)
        if step == "track_stop":
            while "Syncline: tracking stopped" not in texts:
                await asyncio.sleep(0.05)
            exchanged(client, "status texts", ", ".join(dict.fromkeys(texts)))
    reading.cancel()


@pytest.mark.parametrize("client", SERVERS)
def test_an_application_with_mavsdk_finds_the_camera_and_selects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, client: str
) -> None:
    server = STATIONS / SERVERS[client] / "bin" / "mavsdk_server"
    if not server.exists():
        pytest.skip(f"NO {client} HERE: `make faults` installs it")
    monkeypatch.syspath_prepend(str(STATIONS))
    port = int(free_endpoint().rpartition(":")[2])
    with (
        autopilot() as (_, mavlink_port),
        camera_on(f"udpout:127.0.0.1:{mavlink_port}") as camera,
        process(str(server), "-p", str(port), f"udpout://127.0.0.1:{mavlink_port}", folder=tmp_path),
    ):
        asyncio.run(asyncio.wait_for(dialogue(client, port), 60.0))
    # A station repeats a command whose acknowledgement is late (by 0.8 s: once).
    rectangle, point, _ = [command for command, _ in itertools.groupby(camera.commands)]
    assert isinstance(rectangle, SelectTarget)
    assert (rectangle.left, rectangle.top, rectangle.right, rectangle.bottom) == pytest.approx((0.1, 0.2, 0.3, 0.4))
    assert isinstance(point, SelectTarget)
    assert point.is_point


def hears_camera(port: int, patience_s: float) -> bool:
    """Whether a station at MAVProxy's output hears the camera, and can select a target."""
    station = Udp(Url("udpout", "127.0.0.1", port), bound=False)
    codec, reader = M.MAVLink(None, 255, 190), M.MAVLink(None)
    reader.robust_parsing = True
    deadline, due = time.monotonic() + patience_s, 0.0
    try:
        while time.monotonic() < deadline:
            if time.monotonic() > due:
                due = time.monotonic() + 0.5
                box = (0.1, 0.1, 0.2, 0.2, 0.0, 0.0, 0.0)
                for message in (
                    M.MAVLink_heartbeat_message(M.MAV_TYPE_GCS, M.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3),
                    M.MAVLink_command_long_message(1, 100, M.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0, *box),
                ):
                    station.send(bytes(message.pack(codec)), None)
            station.wait(0.1)
            messages = [one for data, _ in station.receive() for one in reader.parse_buffer(data) or []]
            if any(m.get_type() == "COMMAND_ACK" and m.get_srcComponent() == 100 for m in messages):
                return True
        return False
    finally:
        station.close()


@pytest.mark.skipif(not MAVPROXY.exists(), reason="NO MAVPROXY HERE: `make faults` installs it")
@pytest.mark.parametrize("camera_at", ["autopilot", "second output"])
def test_behind_mavproxy_the_camera_is_seen_only_if_it_is_on_the_autopilot(tmp_path: Path, camera_at: str) -> None:
    for_station, for_camera = free_udp_port(), free_udp_port()
    routed = camera_at == "autopilot"
    with autopilot() as (_, port):
        proxy = [sys.executable, str(MAVPROXY), "--daemon", "--no-state", "--mav20", "--default-modules="]
        proxy += ["--streamrate=-1", f"--master=udpout:127.0.0.1:{port}"]
        proxy += [f"--out=udpin:127.0.0.1:{at}" for at in (for_station, for_camera)]
        with (
            process(*proxy, folder=tmp_path),
            camera_on(f"udpout:127.0.0.1:{port if routed else for_camera}") as camera,
        ):
            heard = hears_camera(for_station, 60.0 if routed else 3.0)
    assert heard == routed
    assert bool(camera.commands) == routed
    step = f"camera on the {camera_at}, station at an output: heartbeat, CAMERA_TRACK_RECTANGLE"
    exchanged("MAVProxy", step, "seen, accepted" if routed else "the station does not see the camera")
