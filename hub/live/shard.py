"""One hub of several that share the cameras of a site: whose cameras it takes, and the one answer of all of them.

No sockets, threads or wall clock. The first live hub by name leads: it splits the cameras by the overlaps that all hubs
have seen, and joins their calibrations. The others follow; each knows what the next leader needs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from google.protobuf.message import Message

from hub.distributed.merge import merge_calibrations
from hub.distributed.sharding import OverlapMeter, Pairs, border, split
from hub.live.live_hub import LiveHub, merge_rigs
from hub.live.messages import calibration_from_message, calibration_message
from hub.tracking.detections import tracked_kind
from hub.tracking.handover import TrackHandover
from protocols.core.errors import Refused
from protocols.core.ranges import MAX_CAMERAS
from protocols.messages import syncline_pb2 as pb
from protocols.session.builder import rig_camera_from_info
from protocols.session.calibration import Calibration
from protocols.session.rig import Rig
from protocols.validation.rules import SCHEMA_VERSION

ROLE = "shard"
"""Role under which a hub that shares its site's cameras is announced."""
_PERIOD_S = 1.0  # s: between two publications
_LISTEN_S = 2.0
"""After its start a hub follows before it leads: what the others know has arrived by then."""
_MEET_S = 8.0
"""How long a camera is heard before it goes to a hub: film in which its overlaps show."""
_BORDER_S = 10.0  # s: between two looks at who is across the border, and whether the split is still a good one
_LEAVE_S = 30.0  # s: a camera that has gone for so long is in no group
_MEASURE_S, _DECAY = 2.0, 0.96
"""Of an overlap, each time that both cameras see something, but nothing together: of 30 s 1 s is left after 170 s."""
_MAX_LABELS = 64  # of one frame that overlaps are measured by
_STATES = ("refused", "collecting", "searching", "degraded", "calibrated")  # the worst first


class Shard:
    """The share of the hub ``name``. rig: its own rig.toml. now: any monotonic clock [s].

    groups: of cameras by hub; ``version`` counts them. site: the one calibration, as its leader has published it.
    """

    def __init__(self, name: str, hub: LiveHub, rig: Rig | None = None) -> None:
        self.name, self._hub, self._rig = name, hub, rig
        hub.is_shard = True
        self.groups: dict[str, list[str]] = {}
        self.version = 0
        self.site: pb.Calibration | None = None
        self._mine: frozenset[str] = frozenset()
        self._alive: dict[str, set[str]] = {name: {""}}
        self._infos: dict[str, pb.CameraInfo] = {}
        self._met: dict[str, float] = {}
        self._gone: dict[str, float] = {}
        self._meter, self._overlaps = OverlapMeter(), dict[str, Pairs]()
        self._parts: dict[str, pb.Calibration] = {}
        self._handover = TrackHandover(name)
        self._now, self._began = 0.0, float("inf")
        self._next = self._next_border = self._next_measure = 0.0
        self._overlaps[name] = {}
        self._due = self._is_new = False
        self._revision = 0

    @property
    def leader(self) -> str:
        """The hub that splits the cameras and publishes the site's calibration."""
        return min(self._alive)

    @property
    def leads(self) -> bool:
        """Whether that is this hub."""
        return self.leader == self.name and self._now >= self._began + _LISTEN_S

    @property
    def ignored(self) -> frozenset[str]:
        """Cameras of which this hub needs nothing: they are another's, and not at the border."""
        return frozenset(name for group in self.groups.values() for name in group) - self._mine

    def text(self) -> str:
        """One clause for the status."""
        count = sum(map(len, self.groups.values()))
        return f"has {len(self.groups.get(self.name, ()))} of the site's {count} cameras, {self.leader} leads"

    def on_liveliness(self, role: str, agent: str, boot: str, *, alive: bool) -> None:
        """An agent appeared or disappeared (liveliness token)."""
        if role == "camera":
            if alive:
                self._gone.pop(agent, None)
            else:
                self._gone[agent] = self._now
        elif role == ROLE and agent != self.name:
            boots = self._alive.setdefault(agent, set())
            (boots.add if alive else boots.discard)(boot)
            if not boots:
                del self._alive[agent]
            self._due = True

    def admits(self, topic: str, agent: str, message: Message) -> bool:
        """Take what is for sharing; whether a message is for the hub itself."""
        if isinstance(message, pb.Observation):
            # What had waited for a hub that starts has come all at once.
            if message.camera in self._infos and self._now >= self._began + _LISTEN_S:
                labels = {one.kind if tracked_kind(one) else one.label for one in message.detections[:_MAX_LABELS]}
                self._meter.observe(message.camera, labels, self._now)
            return message.camera in self._mine
        if isinstance(message, pb.CameraInfo):
            if message.camera not in self._infos and len(self._infos) >= MAX_CAMERAS:
                return False
            self._infos[message.camera] = message
            self._met.setdefault(message.camera, self._now)
            return message.camera in self._mine
        if agent == self.name:
            return not isinstance(message, pb.Shard | pb.Calibration | pb.Track)
        if isinstance(message, pb.Shard):
            self._overlaps[agent] = {(one.camera_a, one.camera_b): one.seconds for one in message.overlaps}
            leads = agent == self.leader and message.version == self.version
            if message.version > self.version or leads:
                self._follow({group.hub: list(group.cameras) for group in message.groups}, message.version)
        elif isinstance(message, pb.Calibration):
            if topic == "part":
                self._parts[agent], self._is_new = message, True
            elif message.status == "solved" and agent in self._alive and not self.leads:
                self._use_site(message)
        elif isinstance(message, pb.Track):
            self._handover.hear(message, self._now)
        else:
            return True
        return False

    def own_track(self, track: pb.Track) -> pb.Track | None:
        """A track as it is published; None where another hub does."""
        return self._handover.own(track, self._now)

    def outgoing(self, messages: Iterable[Message]) -> list[tuple[str, Message]]:
        """The hub's messages with the topics on which they are published: its calibrations are parts of the site's."""
        out: list[tuple[str, Message]] = []
        for message in messages:
            if isinstance(message, pb.Calibration):
                self._parts[self.name], self._is_new = message, True
                out.append(("part", message))
            elif isinstance(message, pb.Track):
                track = self.own_track(message)
                out += [] if track is None else [("track", track)]
            else:
                if isinstance(message, pb.Prediction):
                    others = [one for one in message.cameras if one.camera in self.groups.get(self.name, ())]
                    del message.cameras[:]
                    message.cameras.extend(others)
                out.append(("", message))
        return out

    def tick(self, now: float) -> list[tuple[str, Message]]:
        """What is published at ``now``, with its topic: this hub's view of the groups and, of a leader, the site."""
        self._now, self._began = now, min(self._began, now)
        if now < self._next and not self._due:
            return []
        self._next, self._due = now + _PERIOD_S, False
        if now >= self._next_measure:
            self._next_measure = now + _MEASURE_S
            self._measure()
        before = self.version
        if self.leads:
            self._split()
        if now >= self._next_border and self.version == before:
            self._take(self.groups)
        out: list[tuple[str, Message]] = [("shard", self._message())]
        if self.leads and self._is_new:
            self._is_new = False
            out.append(("calibration", self._merged()))
        return out

    def _measure(self) -> None:
        """Renew the overlaps of the cameras that this hub hears."""
        seen, known = self._meter.pairs(), self._overlaps[self.name]
        heard = {name for pair in seen for name in pair}
        faded = {
            pair: seconds * (_DECAY if heard.issuperset(pair) and pair not in seen else 1.0)
            for pair, seconds in known.items()
            if self._infos.keys() >= set(pair)
        }
        every = faded | {pair: max(seconds, faded.get(pair, 0.0)) for pair, seconds in seen.items()}
        self._overlaps[self.name] = {pair: seconds for pair, seconds in every.items() if seconds >= 1.0}

    def _pairs(self) -> Pairs:
        out: Pairs = {}
        for pairs in self._overlaps.values():
            for pair, seconds in pairs.items():
                out[pair] = max(seconds, out.get(pair, 0.0))
        return out

    def _split(self) -> None:
        """Of a leader: the groups, where cameras or hubs have changed."""
        grouped = {name for group in self.groups.values() for name in group}
        pairs = self._pairs()
        overlapping = {name for pair in pairs for name in pair}
        cameras = {
            name
            for name in self._infos.keys() | grouped
            if self._now - self._gone.get(name, self._now) < _LEAVE_S
            if name in grouped or (name in overlapping and self._now - self._met[name] >= _MEET_S)
        }
        is_due = cameras != grouped or self.groups.keys() != self._alive.keys() or self._now >= self._next_border
        if len(cameras) > 1 and is_due:
            groups = split(pairs, cameras, self._alive, self.groups)
            if groups != self.groups:
                self._follow(groups, self.version + 1)

    def _follow(self, groups: Mapping[str, list[str]], version: int) -> None:
        if groups != self.groups or version != self.version:
            self.groups, self.version, self._due = dict(groups), version, True
            self._parts = {hub: part for hub, part in self._parts.items() if hub in self._alive}
            self._take(self.groups)

    def _take(self, groups: Mapping[str, list[str]]) -> None:
        """Hear the cameras of this hub's group and those across its border, with what the site knows of them."""
        self._next_border = self._now + _BORDER_S
        group = frozenset(groups.get(self.name, ()))
        mine = group | border(self._pairs(), group) if group else group
        if mine == self._mine:
            return
        self._hub.release(self._mine - mine)
        new, self._mine = mine - self._mine, mine
        for name in sorted(new & self._infos.keys()):
            self._hub.handle(self._infos[name])
        if self.site is not None:
            site, boots = self._read(self.site)
            known = {name: camera for name, camera in site.cameras.items() if name in mine}
            if self._hub.calibration is None or len(known) > len(mine & self._hub.calibration.cameras.keys()):
                self._hub.adopt(replace(site, cameras=known), boots)
            self._use_site(self.site)

    def _message(self) -> pb.Shard:
        message = pb.Shard(schema_version=SCHEMA_VERSION, hub=self.name, version=self.version)
        message.groups.extend(pb.Shard.Group(hub=hub, cameras=names) for hub, names in self.groups.items())
        message.overlaps.extend(
            pb.Shard.Overlap(camera_a=a, camera_b=b, seconds=s) for (a, b), s in self._overlaps[self.name].items()
        )
        return message

    def _read(self, message: pb.Calibration) -> tuple[Calibration, dict[str, str]]:
        return calibration_from_message(message, self._infos), {one.camera: one.boot_id for one in message.cameras}

    def _merged(self) -> pb.Calibration:
        """Of a leader: the site's calibration from those of all hubs."""
        parts = {hub: part for hub, part in self._parts.items() if hub in self._alive}
        solved = {hub: self._read(part) for hub, part in parts.items() if part.status == "solved"}
        observed = Rig({name: rig_camera_from_info(self._infos[name]) for name in sorted(self._infos)})
        last, boots = (None, {}) if self.site is None else self._read(self.site)
        calibrations = {hub: part for hub, (part, _) in solved.items()}
        clocks = {hub: of_part for hub, (_, of_part) in solved.items()}
        self._revision += 1
        try:
            rig = merge_rigs(observed, self._rig)
            site = merge_calibrations(calibrations, self.groups, rig, clocks, last, boots)
            of_parts = {name: boot for hub in sorted(clocks) for name, boot in clocks[hub].items()}
            for hub, group in self.groups.items():
                of_parts |= {name: clocks[hub][name] for name in group if name in clocks.get(hub, {})}
            before = {} if last is None else last.cameras
            kept = {name: boot for name, boot in boots.items() if site.cameras.get(name) is before.get(name)}
            boots = of_parts | kept
            message = calibration_message(site, self._revision, boots)
        except Refused as refusal:
            message = pb.Calibration(schema_version=SCHEMA_VERSION, revision=self._revision, status="collecting")
            message.reason = refusal.reason
        progress = {one.camera: one for hub, part in parts.items() for one in part.progress
                    if one.camera in self.groups.get(hub, ())}  # fmt: skip
        message.progress.extend(progress.values())
        states = [part.state for part in parts.values() if part.state in _STATES]
        message.state = min(states, key=_STATES.index, default="collecting")
        if message.status == "solved":
            message.state = "calibrated" if message.state == "calibrated" else "degraded"
            self._use_site(message)
        return message

    def _use_site(self, message: pb.Calibration) -> None:
        """Track in the site's world, by its calibration."""
        self.site, self._revision = message, max(self._revision, message.revision)
        site, boots = self._read(message)
        own = frozenset(self.groups.get(self.name, ()))
        self._handover.place({name: one.pose.position for name, one in site.cameras.items()}, own)
        cameras = {name: one for name, one in site.cameras.items() if name in self._mine}
        if len(cameras) > 1:
            self._hub.track_with(replace(site, cameras=cameras), self._rig, boots)
