"""The operator's picture as an RTSP stream (RFC 2326), as QGroundControl, Mission Planner and VLC open it.

libav codes and packs (``RtpEncoder``); here is the dialogue, and who gets the packets: over UDP, or over the RTSP
connection itself where a station asks for that. Pictures are drawn and coded only while somebody watches.
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
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

from edge.devices.base import Image
from edge.video.rtp_encoder import RtpEncoder, is_rtcp
from protocols.core.errors import InputError

PATH = "/overlay"
_MOST_VIEWERS = 4
_MOST_CONNECTIONS = 16
_REQUEST_BYTES = 8192
_SESSION_S = 60  # a viewer that says nothing for so long has gone
_UNSENT_BYTES = 262_144  # waiting for a slow viewer: more, and it gets nothing until the next whole picture
_STALLED_S = 10.0
_AGAIN_S = 0.2  # after which the coding is tried anew
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
    """Serves ``PATH``. host, port: where it listens; port 0: any free one.

    picture: the newest (h, w, 3) BGR, called on a thread of this server; None while there is none. size: (width,
    height) [px]; fps: about how many a second; kbps: at most. Raises InputError where it cannot listen, or no PyAV is.
    """

    def __init__(
        self,
        host: str,
        port: int,
        picture: Callable[[], Image | None],
        size: tuple[int, int],
        fps: float,
        kbps: int = 2000,
    ) -> None:
        self._picture = picture
        self._begin_stream = partial(RtpEncoder, size, fps, kbps)
        self._encoder = self._begin_stream()
        self._changed = threading.Event()
        self._want_key = threading.Event()
        self._closed = False
        self.failures = 0
        """Pictures at which the coding broke down."""
        self._sessions: set[_Session] = set()
        self._connections = 0
        self._loop = asyncio.new_event_loop()
        try:
            self._socket = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        except OSError as error:
            self._loop.close()
            raise InputError(
                f"the video cannot be served at {host}:{port}: {error.strerror}",
                remedy="choose another [video_out] listen",
            ) from None
        self._server = threading.Thread(target=self._serve, name="rtsp", daemon=True)
        self._coder = threading.Thread(target=self._code, name="rtsp pictures", daemon=True)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    @property
    def viewers(self) -> int:
        """How many watch now."""
        return sum(session.playing for session in tuple(self._sessions))

    def changed(self) -> None:
        """There is a new picture."""
        self._changed.set()

    def __enter__(self) -> Self:
        self._server.start()
        self._coder.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closed = True
        self._changed.set()
        self._coder.join(5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._server.join(5.0)

    def _code(self) -> None:
        while not self._closed:
            if not self._changed.wait(1.0):
                continue
            self._changed.clear()
            if self._closed or not self.viewers:
                continue
            image = self._picture()
            if image is None:
                continue
            key = self._want_key.is_set()
            self._want_key.clear()
            try:
                packets = self._encoder.encode(image, time.monotonic(), key=key)
            except Exception:  # noqa: BLE001 - whatever libav has met: the flight goes on, and the video anew
                self.failures += 1
                time.sleep(_AGAIN_S)
                self._encoder = self._begin_stream()
                self._want_key.set()
                continue
            self._loop.call_soon_threadsafe(self._hand_out, packets, key)

    def _hand_out(self, packets: list[bytes], key: bool) -> None:
        for session in tuple(self._sessions):
            if session.playing and not session.send(packets, key):
                self._want_key.set()

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(
            asyncio.start_server(self._talk, sock=self._socket, limit=_REQUEST_BYTES)
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

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, which is one session at most."""
        session = _Session(writer)
        self._connections += 1
        try:
            while self._connections <= _MOST_CONNECTIONS:
                request = await asyncio.wait_for(_read(reader), None if session.rides_along else _SESSION_S)
                if request is None:
                    continue
                if isinstance(request, int):
                    session.answer("0", request)
                    return
                self._obey(session, *request)
                await asyncio.wait_for(writer.drain(), _STALLED_S)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, UnicodeError):
            pass  # it has gone, or speaks something else
        finally:
            self._connections -= 1
            self._sessions.discard(session)
            session.close()

    def _obey(self, session: _Session, method: str, uri: str, headers: dict[str, str]) -> None:
        number = headers.get("cseq", "0")
        path = urlsplit(uri).path.rstrip("/")
        if method != "OPTIONS" and path not in (PATH, f"{PATH}/video"):
            session.answer(number, 404)
        elif method == "OPTIONS":
            session.answer(number, 200, {"Public": _METHODS})
        elif method == "DESCRIBE":
            base = uri.split("?")[0].rstrip("/") + "/"
            session.answer(
                number, 200, {"Content-Base": base, "Content-Type": "application/sdp"}, self._description(session)
            )
        elif method == "SETUP":
            self._set_up(session, number, headers.get("transport", ""))
        elif method not in ("PLAY", "PAUSE", "TEARDOWN", "GET_PARAMETER", "SET_PARAMETER"):
            session.answer(number, 501, {"Public": _METHODS})
        elif method in ("GET_PARAMETER", "SET_PARAMETER") and "session" not in headers:
            session.answer(number, 200)  # only asks whether anybody is there
        elif headers.get("session", "").partition(";")[0].strip() != session.id or session not in self._sessions:
            session.answer(number, 454 if "session" in headers else 455)
        else:
            if method == "PLAY":
                session.play()  # the answer goes out first: pictures are handed out in another round of the loop
                self._want_key.set()
            elif method in ("PAUSE", "TEARDOWN"):
                session.playing = False
            if method == "TEARDOWN":
                self._sessions.discard(session)
            session.answer(number, 200, {"Session": session.id, **({"Range": "npt=now-"} if method == "PLAY" else {})})

    def _set_up(self, session: _Session, number: str, transports: str) -> None:
        if session not in self._sessions and len(self._sessions) >= _MOST_VIEWERS:
            session.answer(number, 453)
            return
        chosen = next((told for told in (session.choose(way) for way in transports.split(",")) if told), None)
        if chosen is None:
            session.answer(number, 461)
            return
        self._sessions.add(session)
        session.answer(number, 200, {"Transport": chosen, "Session": f"{session.id};timeout={_SESSION_S}"})

    def _description(self, session: _Session) -> bytes:
        """The stream as a session description (RFC 4566, RFC 6184 section 8.2.1)."""
        sequence, pictures = self._encoder.parameter_sets
        sets = ",".join(base64.b64encode(unit).decode() for unit in (sequence, pictures))
        kind = "IP6" if ":" in session.own_host else "IP4"
        nowhere = "::" if kind == "IP6" else "0.0.0.0"  # told by SETUP
        lines = (
            "v=0",
            f"o=- 1 1 IN {kind} {session.own_host}",
            "s=Syncline",
            f"c=IN {kind} {nowhere}",
            "t=0 0",
            "a=range:npt=now-",
            "m=video 0 RTP/AVP 96",
            "a=rtpmap:96 H264/90000",
            f"a=fmtp:96 packetization-mode=1;profile-level-id={sequence[1:4].hex()};sprop-parameter-sets={sets}",
            "a=control:video",
        )
        return "".join(f"{line}\r\n" for line in lines).encode()


class _Session:
    """One viewer, on the server's loop. rides_along: its pictures go over the connection itself."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self.id = secrets.token_hex(8)
        self.playing = False
        self.rides_along = False
        self._channels = (0, 1)
        self._sockets: tuple[socket.socket, ...] = ()
        self._ports = (0, 0)
        self._waits = True
        self._sent_s = 0.0
        self.own_host = str(writer.get_extra_info("sockname")[0])
        # Only to where the request came from: nobody can have pictures thrown at somebody else.
        self._host = str(writer.get_extra_info("peername")[0])

    def answer(self, number: str, status: int, headers: dict[str, str] | None = None, body: bytes = b"") -> None:
        """Answer the request of a number."""
        lines = [f"RTSP/1.0 {status} {_REASONS[status]}", f"CSeq: {number}", "Server: Syncline"]
        lines += [f"{name}: {value}" for name, value in (headers or {}).items()]
        if body:
            lines.append(f"Content-Length: {len(body)}")
        self._writer.write("\r\n".join([*lines, "", ""]).encode() + body)

    def choose(self, transport: str) -> str | None:
        """Take one of the transports that were offered; how it is answered, None for one that is not to be had."""
        protocol, *options = (part.strip() for part in transport.split(";"))
        told = dict(option.partition("=")[::2] for option in options)
        if "multicast" in told:
            return None
        if protocol == "RTP/AVP/TCP":
            channels = _pair(told.get("interleaved", "0-1"), 255)
            if channels is None:
                return None
            self._drop_sockets()
            self._channels, self.rides_along = channels, True
            return f"RTP/AVP/TCP;unicast;interleaved={channels[0]}-{channels[1]}"
        ports = _pair(told.get("client_port", ""), 65_535)
        if protocol not in ("RTP/AVP", "RTP/AVP/UDP") or ports is None or min(ports) < 1024:
            return None
        self._drop_sockets()
        self._sockets = _two_sockets(self.own_host)
        if not self._sockets:
            return None
        self._ports, self.rides_along = ports, False
        own = [one.getsockname()[1] for one in self._sockets]
        return f"RTP/AVP;unicast;client_port={ports[0]}-{ports[1]};server_port={own[0]}-{own[1]}"

    def play(self) -> None:
        """From the next whole picture on."""
        self.playing = self._waits = True
        self._sent_s = time.monotonic()

    def send(self, packets: list[bytes], key: bool) -> bool:
        """The packets of one picture; False: this viewer waits for a whole one."""
        if self._waits and not key:
            return False
        if self.rides_along:
            if self._writer.transport.get_write_buffer_size() > _UNSENT_BYTES:
                self._waits = True
                if time.monotonic() - self._sent_s > _STALLED_S:
                    self._writer.transport.abort()
                return False
            self._sent_s = time.monotonic()
            for packet in packets:
                head = b"$" + bytes((self._channels[is_rtcp(packet)],)) + len(packet).to_bytes(2, "big")
                self._writer.write(head + packet)
        else:
            for packet in packets:
                side = int(is_rtcp(packet))
                # A full buffer, or nobody there any more: UDP loses.
                with contextlib.suppress(OSError):
                    self._sockets[side].sendto(packet, (self._host, self._ports[side]))
        self._waits = False
        return True

    def close(self) -> None:
        """Let go of connection and ports."""
        self.playing = False
        self._drop_sockets()
        self._writer.close()

    def _drop_sockets(self) -> None:
        for one in self._sockets:
            one.close()
        self._sockets = ()


async def _read(reader: asyncio.StreamReader) -> tuple[str, str, dict[str, str]] | int | None:
    """The next request as method, uri, headers; a status where it is none; None for a packet in between."""
    first = await reader.readexactly(1)
    if first == b"$":
        await reader.readexactly(int.from_bytes((await reader.readexactly(3))[1:], "big"))  # a receiver's report
        return None
    if first in b"\r\n":
        return None
    line, *lines = (first + await reader.readuntil(b"\r\n\r\n")).decode("ascii").strip().split("\r\n")
    parts = line.split(" ")
    if len(parts) != 3:
        return 400
    if parts[2] != "RTSP/1.0":
        return 505
    headers = {name.strip().lower(): value.strip() for name, _, value in (told.partition(":") for told in lines)}
    length = headers.get("content-length", "0")
    if not length.isdigit() or int(length) > _REQUEST_BYTES or not headers.get("cseq", "").isdigit():
        return 400
    await reader.readexactly(int(length))
    return parts[0], parts[1], headers


def _pair(text: str, most: int) -> tuple[int, int] | None:
    """Two numbers of "8000-8001", or of "8000" alone."""
    low, _, high = text.partition("-")
    if not (low.isascii() and low.isdigit() and len(low) < 6) or (high and not (high.isascii() and high.isdigit())):
        return None
    pair = int(low), int(high[:6]) if high else int(low) + 1
    return pair if max(pair) <= most else None


def _two_sockets(host: str) -> tuple[socket.socket, ...]:
    """UDP sockets on an even port and the one after it (RFC 3550, section 11); () where there are none."""
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
