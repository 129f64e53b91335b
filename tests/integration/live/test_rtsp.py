"""The operator's video over RTSP, read by libav's own RTSP client, over UDP and TCP."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from edge.video import rtsp_server
from edge.video.rtp_encoder import RtpEncoder
from edge.video.rtsp_server import PATH, RtspServer
from protocols.core.errors import InputError
from tests.support.samples import eventually
from tests.support.threads import looping

av: Any = pytest.importorskip("av", reason="PyAV is not installed: nothing of RTSP is tested")
SIZE = (320, 240)
BACK, FRONT = (40, 90, 160), (230, 60, 30)  # BGR


def frame_image(k: int) -> np.ndarray:
    """A square that moves to the right on a plain background."""
    image = np.empty((SIZE[1], SIZE[0], 3), np.uint8)
    image[:] = BACK
    left = 4 * k % 240
    image[80:160, left : left + 80] = FRONT
    return image


@contextmanager
def serving() -> Iterator[RtspServer]:
    """A server with a new image every 20 ms."""
    number = [0]
    with RtspServer("127.0.0.1", 0, lambda: frame_image(number[0]), SIZE, 30.0) as server:

        def show() -> None:
            number[0] += 1
            server.notify_frame()

        with looping(show, 0.02):
            yield server


def exchange(server: RtspServer, *requests: bytes) -> bytes:
    """The response to raw requests on a new connection; b"" where it is refused."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as link:
        answer = b""
        with contextlib.suppress(ConnectionError):
            for request in requests:
                link.sendall(request)
                answer += link.recv(65_536)
        return answer


def request(method: str, path: str = PATH, **headers: str) -> bytes:
    header_lines = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
    return f"{method} rtsp://127.0.0.1{path} RTSP/1.0\r\nCSeq: 7\r\n{header_lines}\r\n".encode()


@pytest.mark.parametrize("transport", ["udp", "tcp"])
def test_libav_decodes_the_served_images(transport: str) -> None:
    with serving() as server:
        uri = f"rtsp://127.0.0.1:{server.port}{PATH}"
        lefts = []
        with av.open(uri, options={"rtsp_transport": transport}, timeout=20.0) as source:
            codec = source.streams.video[0].codec_context
            assert (codec.name, codec.width, codec.height) == ("h264", *SIZE)
            for frame in source.decode(video=0):
                image = frame.to_ndarray(format="bgr24").astype(float)
                square = np.abs(image - FRONT).max(axis=2) < 60
                lefts.append(int(np.flatnonzero(square[120]).min()))
                assert square[90:150].sum() == pytest.approx(60 * 80, rel=0.1)
                np.testing.assert_allclose(image[20, 160], BACK, atol=12)
                if len(lefts) == 25:
                    break
            assert server.viewers == 1
        steps = np.diff(lefts)
        assert ((steps % 240 > 0) & (steps % 240 < 120)).all()  # always newer images, none repeated
        assert eventually(lambda: server.viewers == 0)


def test_a_fifth_viewer_is_refused() -> None:
    with serving() as server:
        links = []
        for k in range(5):
            link = socket.create_connection(("127.0.0.1", server.port), timeout=10)
            links.append(link)
            link.sendall(request("SETUP", PATH + "/video", Transport="RTP/AVP/TCP;unicast;interleaved=0-1"))
            status = link.recv(4096).split()[1]
            assert status == (b"200" if k < 4 else b"453")
        for link in links:
            link.close()
        setup = request("SETUP", Transport="RTP/AVP/TCP;unicast;interleaved=0-1")
        assert eventually(lambda: exchange(server, setup).startswith(b"RTSP/1.0 200"))


def test_a_viewer_that_never_reads_does_not_block_others() -> None:
    with serving() as server:
        stuck = socket.create_connection(("127.0.0.1", server.port), timeout=10)
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.sendall(request("SETUP", Transport="RTP/AVP/TCP;unicast;interleaved=0-1"))
        session = next(line for line in stuck.recv(4096).decode().split("\r\n") if line.startswith("Session"))
        stuck.sendall(request("PLAY", Session=session.split(":")[1].split(";")[0].strip()))
        assert eventually(lambda: server.viewers == 1)
        uri = f"rtsp://127.0.0.1:{server.port}{PATH}"
        with av.open(uri, options={"rtsp_transport": "tcp"}, timeout=20.0) as source:
            frames = source.decode(video=0)
            assert all(next(frames) is not None for _ in range(20))
        stuck.close()


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (request("OPTIONS", "*"), b"200"),
        (request("DESCRIBE", "/other"), b"404"),
        (request("ANNOUNCE"), b"501"),
        (request("PLAY"), b"455"),
        (request("PLAY", Session="1234"), b"454"),
        (request("SETUP", Transport="RTP/AVP;multicast;client_port=5000-5001"), b"461"),
        (request("SETUP", Transport="RTP/AVP;unicast;client_port=5-99999999999999999999"), b"461"),
        (request("SETUP", Transport="RTP/AVP;unicast;destination=10.0.0.9;client_port=53-54"), b"461"),
        (request("SETUP"), b"461"),
        (request("GET_PARAMETER"), b"200"),
        (request("DESCRIBE", Content_Length="-1"), b"400"),
        (b"OPTIONS * RTSP/2.0\r\nCSeq: 1\r\n\r\n", b"505"),
        (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"505"),
        (b"nonsense\r\n\r\n", b"400"),
        (b"DESCRIBE rtsp://[ RTSP/1.0\r\nCSeq: 1\r\n\r\n", b"400"),
        (b"DESCRIBE rtsp://x/overlay\nX:1 RTSP/1.0\r\nCSeq: 1\r\n\r\n", b"400"),
    ],
)
def test_requests_get_the_status_codes_of_the_standard(sent: bytes, status: bytes) -> None:
    with serving() as server:
        assert exchange(server, sent).split()[1] == status


def test_random_bytes_end_only_their_own_connection() -> None:
    rng = np.random.default_rng(5)
    with serving() as server:
        for _ in range(20):
            with (
                contextlib.suppress(ConnectionError),
                socket.create_connection(("127.0.0.1", server.port), timeout=10) as link,
            ):
                link.sendall(rng.bytes(20_000))
        assert eventually(lambda: exchange(server, request("OPTIONS")).startswith(b"RTSP/1.0 200"))


def test_a_session_can_be_resumed_after_pause_and_not_after_teardown() -> None:
    with serving() as server, socket.create_connection(("127.0.0.1", server.port), timeout=10) as link:
        link.sendall(request("SETUP", Transport="RTP/AVP;unicast;client_port=50000-50001"))
        answer = link.recv(4096).decode()
        assert "server_port=" in answer
        session = answer.partition("Session: ")[2].partition(";")[0]
        for method, status, viewers in (
            ("PLAY", "200", 1),
            ("PAUSE", "200", 0),
            ("GET_PARAMETER", "200", 0),
            ("PLAY", "200", 1),
            ("GET_PARAMETER", "200", 1),
            ("TEARDOWN", "200", 0),
            ("PLAY", "454", 0),
        ):
            link.sendall(request(method, Session=session))
            assert link.recv(4096).decode().split()[1] == status
            assert server.viewers == viewers, method


SETUP = request("SETUP", Transport="RTP/AVP/TCP;unicast;interleaved=0-1")


def test_places_that_are_set_up_and_not_played_are_given_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four SETUPs without PLAY held all places for as long as their connections were open, or kept alive."""
    monkeypatch.setattr(rtsp_server, "_SETUP_TIMEOUT_S", 0.3)
    links: list[socket.socket] = []
    with serving() as server, contextlib.ExitStack() as stack:
        for _ in range(4):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=10))
            link.sendall(SETUP)
            assert link.recv(4096).startswith(b"RTSP/1.0 200")
            links.append(link)

        def others_are_served() -> bool:
            for link in links:
                link.sendall(request("OPTIONS"))
            return exchange(server, SETUP).startswith(b"RTSP/1.0 200")

        assert eventually(others_are_served)


def test_silent_connections_do_not_lock_others_out() -> None:
    """Sixteen connections without a word were all that the server took, for a minute each."""
    with serving() as server, contextlib.ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=10))
        assert exchange(server, request("OPTIONS")).startswith(b"RTSP/1.0 200")
        assert len(server._connections) <= 17


def test_connections_that_are_open_at_the_end_are_no_error(caplog: pytest.LogCaptureFixture) -> None:
    """Each was a traceback."""
    with contextlib.ExitStack() as stack, serving() as server:
        for _ in range(3):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=10))
        exchange(server, request("OPTIONS"))
    assert caplog.records == []


def test_an_error_in_a_connection_is_no_traceback(caplog: pytest.LogCaptureFixture) -> None:
    with serving() as server:
        exchange(server, b"SETUP rtsp://[::1/overlay RTSP/1.0\r\nCSeq: 1\r\n\r\n", SETUP)
        exchange(
            server, request("SETUP", Transport="RTP/AVP;unicast;client_port=5000-\u0665".encode().decode("latin1"))
        )
    assert caplog.records == []


def test_an_encoder_failure_costs_one_image_only(monkeypatch: pytest.MonkeyPatch) -> None:
    code, failed = RtpEncoder.encode, []

    def fails_once(encoder: RtpEncoder, *arguments: Any, **options: Any) -> list[bytes]:
        if not failed:
            failed.append(encoder)
            raise av.error.ExternalError(1, "broken", "libx264")
        return code(encoder, *arguments, **options)

    monkeypatch.setattr(RtpEncoder, "encode", fails_once)
    with serving() as server:
        uri = f"rtsp://127.0.0.1:{server.port}{PATH}"
        with av.open(uri, options={"rtsp_transport": "tcp"}, timeout=20.0) as source:
            frames = source.decode(video=0)
            assert all(next(frames).width == SIZE[0] for _ in range(5))
        assert (server.failures, len(failed)) == (1, 1)


def test_an_occupied_port_is_refused_with_a_remedy() -> None:
    with serving() as server, pytest.raises(InputError, match="choose another"):
        RtspServer("127.0.0.1", server.port, lambda: None, SIZE, 30.0)


def test_without_pyav_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(InputError, match=r"syncline\[video\]"):
        RtspServer("127.0.0.1", 0, lambda: None, SIZE, 30.0)
