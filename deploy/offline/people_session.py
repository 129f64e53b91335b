"""Sessions of several unlabelled people: boxes, or heads and feet."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from deploy.offline.follow.objects import (
    complete_detections,
    followed_detections,
    is_boxes_file,
    object_messages,
    read_objects,
    without_clock_steps,
)
from hub.api import RecordedSession
from hub.tracking.calibration.people import MIN_INTERVAL_NS, SEVERAL_SHARE
from protocols.core.errors import Refused
from protocols.messages import syncline_pb2 as pb
from protocols.session.csv_table import read_csv_header, read_csv_table
from protocols.session.folder import BOXES_FILE, OBSERVATIONS_FILE, RIG_FILE
from protocols.session.observations import Observations
from protocols.session.rig import Rig, misspelt_keys, read_rig


def people_session(session: str | Path, observations: str | Path | None = None) -> RecordedSession | None:
    """The session of a folder, if its table has several unlabelled people; else None. Raises InputError.

    observations: another table in place of the folder's own.
    """
    session, observations = Path(session), None if observations is None else Path(observations)
    file = observations or next((session / n for n in (OBSERVATIONS_FILE, BOXES_FILE) if (session / n).exists()), None)
    if file is None or not file.exists() or not (session / RIG_FILE).exists():
        return None
    if not is_boxes_file(file) and not _are_several(file):
        return None
    rig, people, warnings = read_people(file, session / RIG_FILE)
    return RecordedSession(rig, Observations({}), (*misspelt_keys(rig), *warnings), session.name, people=people)


def read_people(file: Path, rig_file: Path) -> tuple[Rig, tuple[pb.Observation, ...], tuple[str, ...]]:
    """The rig, its people with head and foot, by camera and time, and warnings. Raises InputError.

    Of frames that are less than `MIN_INTERVAL_NS` apart only the first is taken.
    """
    rig = read_rig(rig_file)
    sizes = {name: camera.size for name, camera in rig.cameras.items()}
    messages, steps = without_clock_steps(object_messages(read_objects(file, sizes), MIN_INTERVAL_NS), file)
    complete_detections(messages, "person", sizes)
    people, left_out = followed_detections(messages, "person", sizes)
    if not any(message.detections for message in people):
        raise Refused("; ".join((f"{file}: nobody in it whose head and foot are given", *left_out.warnings)))
    return rig, tuple(people), (*steps, *left_out.warnings)


def _are_several(file: Path) -> bool:
    """Whether rows of one label are several people of one frame."""
    if "kind" not in read_csv_header(file, "observations"):
        return False
    table = read_csv_table(file, "observations", ("camera", "time", "kind"), ("label",))
    kinds = set(table.text("kind"))
    if not kinds <= {"", "person"} or "person" not in kinds:
        return False
    label = table.text("label") if "label" in table.columns else [""] * len(table)
    each = Counter(zip(table.text("camera"), label, table.text("time"), strict=True))
    return sum(count > 1 for count in each.values()) > SEVERAL_SHARE * len(each)
