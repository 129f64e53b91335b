"""An RTSP server (RFC 2326) for the operator's video, as QGroundControl, Mission Planner and VLC open it.

``RtpEncoder`` encodes and packetises; this module holds the RTSP dialogue and distributes the packets: over UDP, or
interleaved in the RTSP connection where a client asks for that. Images are drawn and encoded only while somebody plays.

Places go by activity: who does not play holds one for ``_SETUP_TIMEOUT_S``, and of more than ``_MAX_CONNECTIONS``
connections the one that has been idle longest is closed, so that silent ones do not lock others out.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import secrets
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Self
from urllib.parse import urlsplit

from edge.video.rtp_encoder import RtpEncoder, is_rtcp
from protocols.core.errors import InputError
from protocols.geometry.types import Image

PATH = "/overlay"
_MAX_VIEWERS = 4  # of the operator's video, 2 Mbit/s each
_MAX_CONNECTIONS = 16  # with those that are turned away
_MAX_REQUEST_BYTES = 8192  # players send some hundred
_SESSION_TIMEOUT_S = 60  # without a request for this long the client is dropped
_SETUP_TIMEOUT_S = 5.0  # how long a viewer's place is held between SETUP (or PAUSE) and PLAY, and the first request
_MAX_UNSENT_BYTES = 262_144  # queued for a slow client: beyond this it is skipped until the next key frame
_STALL_TIMEOUT_S = 10.0  # for which a viewer may take nothing
_ENCODER_RETRY_S = 0.2  # pause before the encoder is recreated after a failure
_METHODS = "OPTIONS, DESCRIBE, SETUP, PLAY, PAUSE, TEARDOWN, GET_PARAMETER, SET_PARAMETER"
_REASONS = {
    200: "OK",
    400: "Bad Request",
    404: "Not Found",
    453: "Not Enough Bandwidth",
    454: "Session Not Found",
    455: "Method Not Valid in This State",
    461: "Unsupported Transport",
    501: "Not Implemented",
    505: "RTSP Version Not Supported",
}


class RtspServer:
    """Serves ``PATH``. host, port: listening address; port 0: any free one.

    latest_image: gives the newest (h, w, 3) BGR, called in a thread of this server; None while there is none. size:
    (width, height) [px]; fps: nominal rate; kbps: maximum bit rate. Raises InputError where it cannot listen or PyAV is
    missing.
    """

    def __init__(
        self,
        host: str,
        port: int,
        latest_image: Callable[[], Image | None],
        size: tuple[int, int],
        fps: float,
        kbps: int = 2000,
    ) -> None:
        self._latest_image = latest_image
        self._make_encoder = partial(RtpEncoder, size, fps, kbps)
        self._encoder = self._make_encoder()
        self._new_frame = threading.Event()
        self._key_frame_wanted = threading.Event()
        self._closed = False
        self.failures = 0
        """Number of images at which the encoder failed."""
        self._sessions: set[_Session] = set()
        self._connections: set[_Session] = set()
        self._loop = asyncio.new_event_loop()
        try:
            self._socket = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        except OSError as error:
            self._loop.close()
            raise InputError(
                f"the video cannot be served at {host}:{port}: {error.strerror}",
                remedy="choose another [video_out] listen",
            ) from None
        self._server_thread = threading.Thread(target=self._serve, name="rtsp", daemon=True)
        self._encoder_thread = threading.Thread(target=self._encode_frames, name="rtsp encoder", daemon=True)

    @property
    def port(self) -> int:
        """The listening port."""
        return int(self._socket.getsockname()[1])

    @property
    def viewers(self) -> int:
        """Number of present viewers."""
        return sum(session.playing for session in tuple(self._sessions))

    def notify_frame(self) -> None:
        """Notify the encoder of a new image."""
        self._new_frame.set()

    def __enter__(self) -> Self:
        self._server_thread.start()
        self._encoder_thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._new_frame.set()
        self._encoder_thread.join(5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._server_thread.join(5.0)

    def _encode_frames(self) -> None:
        while not self._closed:
            if not self._new_frame.wait(1.0):
                continue
            self._new_frame.clear()
            if self._closed or not self.viewers:
                continue
            image = self._latest_image()
            if image is None:
                continue
            key_frame = self._key_frame_wanted.is_set()
            self._key_frame_wanted.clear()
            try:
                packets = self._encoder.encode(image, time.monotonic(), key_frame=key_frame)
            except Exception:  # noqa: BLE001 - any libav error: restart the encoder, never stop the agent
                self.failures += 1
                time.sleep(_ENCODER_RETRY_S)
                self._encoder = self._make_encoder()
                self._key_frame_wanted.set()
                continue
            self._loop.call_soon_threadsafe(self._distribute, packets, key_frame)

    def _distribute(self, packets: list[bytes], key_frame: bool) -> None:
        for session in tuple(self._sessions):
            if session.playing and not session.send(packets, key_frame):
                self._key_frame_wanted.set()

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(
            asyncio.start_server(self._handle_connection, sock=self._socket, limit=_MAX_REQUEST_BYTES)
        )
        try:
            self._loop.run_forever()
        finally:
            server.close()
            tasks = asyncio.all_tasks(self._loop)
            for task in tasks:
                task.cancel()
            self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
            self._loop.close()

    async def _handle_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Handle one connection, which has at most one session."""
        session = _Session(writer)
        idle = [other for other in self._connections if not other.playing]
        if len(self._connections) >= _MAX_CONNECTIONS and idle:
            longest = min(idle, key=lambda other: other.active_s)
            self._connections.discard(longest)
            longest.abort()
        self._connections.add(session)
        limit: float | None = _SETUP_TIMEOUT_S
        try:
            while True:
                request = await asyncio.wait_for(_read_request(reader), limit)
                session.active_s = time.monotonic()
                if isinstance(request, int):
                    session.respond("0", request)
                    return
                if request is not None:
                    self._handle_request(session, *request)
                    await asyncio.wait_for(writer.drain(), _STALL_TIMEOUT_S)
                # Who reads the stream in this connection shows thereby that it is there.
                limit = None if session.interleaved and session.playing else _SESSION_TIMEOUT_S
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, ValueError):
            pass  # disconnected, or not RTSP
        except asyncio.CancelledError:
            pass  # the server ends; as the end of its task, asyncio would report it as an error
        finally:
            self._connections.discard(session)
            self._sessions.discard(session)
            session.close()

    def _handle_request(self, session: _Session, method: str, uri: str, headers: dict[str, str]) -> None:
        number = headers.get("cseq", "0")
        try:
            path = urlsplit(uri).path.rstrip("/")
        except ValueError:
            session.respond(number, 400)
            return
        if method != "OPTIONS" and path not in (PATH, f"{PATH}/video"):
            session.respond(number, 404)
        elif method == "OPTIONS":
            session.respond(number, 200, {"Public": _METHODS})
        elif method == "DESCRIBE":
            base = uri.split("?")[0].rstrip("/") + "/"
            session.respond(
                number, 200, {"Content-Base": base, "Content-Type": "application/sdp"}, self._description(session)
            )
        elif method == "SETUP":
            self._set_up(session, number, headers.get("transport", ""))
        elif method not in ("PLAY", "PAUSE", "TEARDOWN", "GET_PARAMETER", "SET_PARAMETER"):
            session.respond(number, 501, {"Public": _METHODS})
        elif method in ("GET_PARAMETER", "SET_PARAMETER") and "session" not in headers:
            session.respond(number, 200)  # keep-alive
        elif headers.get("session", "").partition(";")[0].strip() != session.id or session not in self._sessions:
            session.respond(number, 454 if "session" in headers else 455)
        elif method == "PLAY" and self._is_full(session):
            session.respond(number, 453)
        else:
            if method == "PLAY":
                session.play()  # the response goes out first: packets are distributed later in the event loop
                self._key_frame_wanted.set()
            elif method in ("PAUSE", "TEARDOWN"):
                session.playing, session.held_s = False, time.monotonic()
            if method == "TEARDOWN":
                self._sessions.discard(session)
            session.respond(number, 200, {"Session": session.id, **({"Range": "npt=now-"} if method == "PLAY" else {})})

    def _set_up(self, session: _Session, number: str, transports: str) -> None:
        if self._is_full(session):
            session.respond(number, 453)
            return
        chosen = next((header for offer in transports.split(",") if (header := session.select_transport(offer))), None)
        if chosen is None:
            session.respond(number, 461)
            return
        if session not in self._sessions:
            session.held_s = time.monotonic()
        self._sessions.add(session)
        session.respond(number, 200, {"Transport": chosen, "Session": f"{session.id};timeout={_SESSION_TIMEOUT_S}"})

    def _is_full(self, session: _Session) -> bool:
        """Whether others hold all places: those who play, and who may be about to."""
        now = time.monotonic()
        holders = [one for one in self._sessions if one.playing or now - one.held_s < _SETUP_TIMEOUT_S]
        return len(set(holders) - {session}) >= _MAX_VIEWERS

    def _description(self, session: _Session) -> bytes:
        """The stream as a session description (RFC 4566, RFC 6184 section 8.2.1)."""
        sequence_set, picture_set = self._encoder.parameter_sets
        sets = ",".join(base64.b64encode(unit).decode() for unit in (sequence_set, picture_set))
        kind = "IP6" if ":" in session.own_host else "IP4"
        nowhere = "::" if kind == "IP6" else "0.0.0.0"  # the address is negotiated by SETUP
        lines = (
            "v=0",
            f"o=- 1 1 IN {kind} {session.own_host}",
            "s=Syncline",
            f"c=IN {kind} {nowhere}",
            "t=0 0",
            "a=range:npt=now-",
            "m=video 0 RTP/AVP 96",
            "a=rtpmap:96 H264/90000",
            f"a=fmtp:96 packetization-mode=1;profile-level-id={sequence_set[1:4].hex()};sprop-parameter-sets={sets}",
            "a=control:video",
        )
        return "".join(f"{line}\r\n" for line in lines).encode()


class _Session:
    """One client, used on the server's event loop. interleaved: its packets go over the RTSP connection itself."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self.id = secrets.token_hex(8)
        self.playing = False
        self.interleaved = False
        self._channels = (0, 1)
        self._sockets: tuple[socket.socket, ...] = ()
        self._ports = (0, 0)
        self._awaiting_key_frame = True
        self._sent_s = 0.0
        self.active_s = time.monotonic()
        """When the last request came."""
        self.held_s = 0.0
        """When SETUP or PAUSE came: requests that keep a connection alive do not keep a place."""
        self.own_host = str(writer.get_extra_info("sockname")[0])
        # Only to the client's own address, so that the server cannot be used to flood a third party.
        self._host = str(writer.get_extra_info("peername")[0])

    def respond(self, number: str, status: int, headers: dict[str, str] | None = None, body: bytes = b"") -> None:
        """Respond to the request with CSeq ``number``."""
        lines = [f"RTSP/1.0 {status} {_REASONS[status]}", f"CSeq: {number}", "Server: Syncline"]
        lines += [f"{name}: {value}" for name, value in (headers or {}).items()]
        if body:
            lines.append(f"Content-Length: {len(body)}")
        self._writer.write("\r\n".join([*lines, "", ""]).encode() + body)

    def select_transport(self, transport: str) -> str | None:
        """Select an offered transport; its Transport header, None if it is not supported."""
        protocol, *options = (part.strip() for part in transport.split(";"))
        fields = dict(option.partition("=")[::2] for option in options)
        if "multicast" in fields:
            return None
        if protocol == "RTP/AVP/TCP":
            channels = _parse_pair(fields.get("interleaved", "0-1"), 255)
            if channels is None:
                return None
            self._drop_sockets()
            self._channels, self.interleaved = channels, True
            return f"RTP/AVP/TCP;unicast;interleaved={channels[0]}-{channels[1]}"
        ports = _parse_pair(fields.get("client_port", ""), 65_535)
        if protocol not in ("RTP/AVP", "RTP/AVP/UDP") or ports is None or min(ports) < 1024:
            return None
        self._drop_sockets()
        self._sockets = _rtp_socket_pair(self.own_host)
        if not self._sockets:
            return None
        self._ports, self.interleaved = ports, False
        own = [one.getsockname()[1] for one in self._sockets]
        return f"RTP/AVP;unicast;client_port={ports[0]}-{ports[1]};server_port={own[0]}-{own[1]}"

    def play(self) -> None:
        """Start sending, from the next key frame on."""
        self.playing = self._awaiting_key_frame = True
        self._sent_s = time.monotonic()

    def send(self, packets: list[bytes], key_frame: bool) -> bool:
        """Send the packets of one image; False: this client waits for a key frame."""
        if self._awaiting_key_frame and not key_frame:
            return False
        if self.interleaved:
            if self._writer.transport.get_write_buffer_size() > _MAX_UNSENT_BYTES:
                self._awaiting_key_frame = True
                if time.monotonic() - self._sent_s > _STALL_TIMEOUT_S:
                    self.abort()
                return False
            self._sent_s = time.monotonic()
            for packet in packets:
                head = b"$" + bytes((self._channels[is_rtcp(packet)],)) + len(packet).to_bytes(2, "big")
                self._writer.write(head + packet)
        else:
            for packet in packets:
                side = int(is_rtcp(packet))
                # The buffer is full or the client is gone: the packet is lost.
                with contextlib.suppress(OSError):
                    self._sockets[side].sendto(packet, (self._host, self._ports[side]))
        self._awaiting_key_frame = False
        return True

    def abort(self) -> None:
        """End the connection at once; its reader then closes the session."""
        self._writer.transport.abort()

    def close(self) -> None:
        """Close the connection and the UDP sockets."""
        self.playing = False
        self._drop_sockets()
        self._writer.close()

    def _drop_sockets(self) -> None:
        for one in self._sockets:
            one.close()
        self._sockets = ()


async def _read_request(reader: asyncio.StreamReader) -> tuple[str, str, dict[str, str]] | int | None:
    """The next request as method, uri, headers; an RTSP status for an invalid one; None for an interleaved packet."""
    first = await reader.readexactly(1)
    if first == b"$":
        await reader.readexactly(int.from_bytes((await reader.readexactly(3))[1:], "big"))  # an RTCP receiver report
        return None
    if first in b"\r\n":
        return None
    line, *lines = (first + await reader.readuntil(b"\r\n\r\n")).decode("ascii").strip().split("\r\n")
    parts = line.split(" ")
    if len(parts) != 3 or not line.isprintable():
        return 400
    if parts[2] != "RTSP/1.0":
        return 505
    headers = {name.strip().lower(): value.strip() for name, _, value in (text.partition(":") for text in lines)}
    length = headers.get("content-length", "0")
    if not length.isdigit() or int(length) > _MAX_REQUEST_BYTES or not headers.get("cseq", "").isdigit():
        return 400
    await reader.readexactly(int(length))
    return parts[0], parts[1], headers


def _parse_pair(text: str, most: int) -> tuple[int, int] | None:
    """Parse "8000-8001", or "8000" alone as a pair."""
    low, _, high = text.partition("-")
    if not (low.isascii() and low.isdigit() and len(low) < 6) or (high and not (high.isascii() and high.isdigit())):
        return None
    pair = int(low), int(high[:6]) if high else int(low) + 1
    return pair if max(pair) <= most else None


def _rtp_socket_pair(host: str) -> tuple[socket.socket, ...]:
    """UDP sockets on an even port and the next one (RFC 3550, section 11); () if none are free."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for _ in range(30):
        pair = (socket.socket(family, socket.SOCK_DGRAM), socket.socket(family, socket.SOCK_DGRAM))
        try:
            pair[0].bind((host, 0))
            port = pair[0].getsockname()[1]
            if port % 2 == 0:
                pair[1].bind((host, port + 1))
                for one in pair:
                    one.setblocking(False)
                return pair
        except OSError:
            pass
        for one in pair:
            one.close()
    return ()
