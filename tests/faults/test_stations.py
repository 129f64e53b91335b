"""Ground stations as real processes, MAVSDK's server and MAVProxy, at a simulated autopilot with a camera behind it.

`make faults` installs both into the folder `stations` of its environment (MAVProxy's own requirements would replace
OpenCV by another build). Where they cannot be had, these tests are skipped.
"""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pymavlink")
from edge.mavlink.dialect import mavlink as M
from edge.mavlink.link.transport import Udp, Url
from tests.faults.matrix import measured
from tests.support.vehicle_link import URI, autopilot, camera_on

STATIONS = Path(sys.prefix) / "stations"
SERVER = STATIONS / "mavsdk" / "bin" / "mavsdk_server"
MAVPROXY = STATIONS / "bin" / "mavproxy.py"


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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


async def dialogue(port: int) -> dict[str, Any]:
    """What an application with MAVSDK does with a camera."""
    import mavsdk

    drone = mavsdk.System(mavsdk_server_address="127.0.0.1", port=port)
    await drone.connect()
    seen: dict[str, Any] = {"texts": []}
    async for cameras in drone.camera.camera_list():
        if cameras.cameras:
            seen["model"] = cameras.cameras[0].model_name
            camera = cameras.cameras[0].component_id
            break
    for _ in range(50):  # MAVSDK asks for it after the camera's information
        seen["uri"] = (await drone.camera.get_video_stream_info(camera)).settings.uri
        if seen["uri"]:
            break
        await asyncio.sleep(0.1)

    async def read_texts() -> None:
        async for text in drone.telemetry.status_text():
            seen["texts"].append(text.text)

    reading = asyncio.create_task(read_texts())
    await asyncio.sleep(0.2)
    await drone.camera.start_video_streaming(camera, 1)
    await drone.camera.track_rectangle(camera, 0.1, 0.2, 0.3, 0.4)
    await drone.camera.track_point(camera, 0.5, 0.25, 0.1)
    await drone.camera.track_stop(camera)
    for _ in range(50):
        if "Syncline: tracking stopped" in seen["texts"]:
            break
        await asyncio.sleep(0.05)
    with pytest.raises(mavsdk.camera.CameraError, match="DENIED"):
        await drone.camera.start_video_streaming(camera, 7)
    reading.cancel()
    return seen


@pytest.mark.skipif(not SERVER.exists(), reason="NO MAVSDK HERE: `make faults` installs it")
@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_an_application_with_mavsdk_finds_the_camera_and_selects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(STATIONS))
    port = free_port(socket.SOCK_STREAM)
    with (
        autopilot() as (_, mavlink_port),
        camera_on(f"udpout:127.0.0.1:{mavlink_port}") as camera,
        process(str(SERVER), "-p", str(port), f"udpout://127.0.0.1:{mavlink_port}", folder=tmp_path),
    ):
        seen = asyncio.run(asyncio.wait_for(dialogue(port), 30.0))
    assert (seen["model"], seen["uri"]) == ("Syncline UAV tracker", URI)
    assert seen["texts"][-1] == "Syncline: tracking stopped"
    left, top, right, bottom = 0.1, 0.2, 0.3, 0.4
    rectangle, point, _ = camera.commands
    assert (rectangle.left, rectangle.top, rectangle.right, rectangle.bottom) == pytest.approx(  # type: ignore[union-attr]
        (left, top, right, bottom)
    )
    assert point.is_point  # type: ignore[union-attr]
    measured("MAVSDK: camera, stream, rectangle, point, stop", "all answered", f"texts: {len(seen['texts'])}")


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
    for_station, for_camera = free_port(), free_port()
    routed = camera_at == "autopilot"
    with autopilot() as (_, port):
        proxy = [sys.executable, str(MAVPROXY), "--daemon", "--no-state", "--mav20", "--default-modules="]
        proxy += ["--streamrate=-1", f"--master=udpout:127.0.0.1:{port}"]
        proxy += [f"--out=udpin:127.0.0.1:{at}" for at in (for_station, for_camera)]
        with (
            process(*proxy, folder=tmp_path),
            camera_on(f"udpout:127.0.0.1:{port if routed else for_camera}") as camera,
        ):
            heard = hears_camera(for_station, 15.0 if routed else 3.0)
    assert heard == routed
    assert bool(camera.commands) == routed
    measured(f"MAVProxy: camera on the {camera_at}", "seen" if routed else "not seen", "as the guide says")
