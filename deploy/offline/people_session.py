"""Sessions of several people whom nobody has told apart: boxes, or heads and feet, without labels."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from deploy.offline.follow.objects import (
    BOXES_FILE,
    complete_detections,
    followed_detections,
    is_boxes_file,
    object_messages,
    read_objects,
)
from hub.api import RecordedSession
from protocols.log.read.reader import LogReader
from protocols.log.read.session import is_log
from protocols.messages import syncline_pb2 as pb
from protocols.session.detections import read_detections
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE
from protocols.session.observations import Observations
from protocols.session.rig import Rig, misspelt_keys, read_rig
from protocols.session.session import Session
from protocols.topics import OBSERVATION

_SEVERAL_SHARE = 0.02
"""Of a camera's frames, in which there are several people: false detections beside one person are fewer."""


def people_session(session: Path, observations: Path | None) -> RecordedSession | None:
    """The session of a folder, if its table has several unlabelled people; else None. Raises InputError."""
    file = observations or next((session / n for n in (OBSERVATIONS_FILE, BOXES_FILE) if (session / n).exists()), None)
    if file is None or not file.exists() or not (session / RIG_FILE).exists():
        return None
    rig = read_rig(session / RIG_FILE)
    if not is_boxes_file(file) and not _are_several(file, rig):
        return None
    rig, people = read_people(file, session / RIG_FILE)
    return RecordedSession(rig, Observations({}), misspelt_keys(rig), session.name, people=people)


def people_of_log(log: Path, read: Session) -> Session:
    """The session of a log; with its unlabelled people where nothing else was observed in it."""
    if read.observations.tracks or not is_log(log):
        return read
    messages = [logged.message for logged in LogReader(log).messages([OBSERVATION])]
    rows = [message for message in messages if isinstance(message, pb.Observation)]
    people, _ = followed_detections(rows, "person", {name: one.size for name, one in read.rig.cameras.items()})
    priors = read.clock_priors if isinstance(read, RecordedSession) else {}
    return RecordedSession(read.rig, read.observations, read.warnings, read.name, priors, people=tuple(people))


def read_people(file: Path, rig_file: Path) -> tuple[Rig, tuple[pb.Observation, ...]]:
    """The rig, and its people with head and foot, by camera and time. Raises InputError."""
    rig = read_rig(rig_file)
    sizes = {name: camera.size for name, camera in rig.cameras.items()}
    messages = object_messages(read_objects(file, sizes))
    complete_detections(messages, "person", sizes)
    people, _ = followed_detections(messages, "person", sizes)
    return rig, tuple(people)


def _are_several(file: Path, rig: Rig) -> bool:
    """Whether rows of one label are several people of one frame."""
    rows = read_detections(file, {name: camera.size for name, camera in rig.cameras.items()})
    if not set(rows.kind) <= {"", "person"} or not any(rows.kind):
        return False
    each = Counter(zip(rows.camera, rows.label, rows.time.tolist(), strict=True))
    return sum(count > 1 for count in each.values()) > _SEVERAL_SHARE * len(each)
