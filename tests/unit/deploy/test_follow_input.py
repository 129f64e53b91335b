"""What `syncline follow` reads: boxes, heads and feet, empty frames, times, units; bad input gets one line."""

from __future__ import annotations

import re
import tomllib
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from deploy.offline.follow import units
from deploy.offline.follow.calibration import read_given_calibration
from deploy.offline.follow.objects import followed_detections, object_messages, read_objects
from deploy.offline.follow.source import FollowInput, read_follow_input
from edge.scenes.common.base import look_at_pose
from hub.tracking.offline import FollowedTrack
from protocols.core.errors import InputError, Refused
from protocols.geometry import so3
from protocols.geometry.pose import POSE_CONVENTIONS, Pose
from protocols.geometry.types import Floats
from tests.support import crowds
from tests.support.crowds import NAMES, SIZE, boxes_csv, ends, poses, write_calibration

SIZES = dict.fromkeys(NAMES, SIZE)
_UP = np.diag([1.0, -1.0, -1.0])
_WRITTEN: dict[str, Callable[[Pose], Pose]] = dict(
    zip(
        POSE_CONVENTIONS,
        [
            lambda meant: Pose(meant.rotation, -meant.rotation.T @ meant.position),
            lambda meant: Pose(meant.rotation.T, -meant.rotation @ meant.position),
            lambda meant: Pose(meant.rotation.T, -meant.rotation @ meant.translation),
            lambda meant: Pose(_UP @ meant.rotation, meant.position),
            lambda meant: Pose((_UP @ meant.rotation).T, -_UP @ meant.rotation @ meant.position),
        ],
        strict=True,
    )
)
"""What stands in a file that is written in each convention, as the pose that is read from it."""
BOXES = "camera,frame,time,x,y,width,height\n"


def read(folder: Path, boxes: str, **options: object) -> FollowInput:
    """Read boxes with the made-up calibration."""
    (folder / "boxes.csv").write_text(boxes, encoding="utf-8")
    known = read_given_calibration(write_calibration(folder / "calibration.toml"))
    return read_follow_input(folder / "boxes.csv", known, "person", folder, **options)  # type: ignore[arg-type]


def rows(folder: Path, text: str) -> Path:
    """A CSV file."""
    file = folder / "rows.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_box_is_an_upright_person(tmp_path: Path) -> None:
    table = read_objects(rows(tmp_path, BOXES + "left,0,0.5,100,200,40,-0\n".replace("-0", "160")), SIZES)
    (message,), left = followed_detections(object_messages(table), "person", SIZES)
    (one,) = message.detections
    assert (list(one.head), list(one.foot)) == ([120.0, 200.0], [120.0, 360.0])
    assert (one.u, one.v, one.size, one.kind) == (120.0, 280.0, 160.0, "person")
    assert (message.sequence, message.device_time_ns) == (0, 500_000_000)
    assert left.warnings == ()


def test_a_box_that_ends_at_the_border_has_no_foot_there(tmp_path: Path) -> None:
    text = BOXES + f"left,0,0,100,600,40,{SIZE[1] - 600}\nleft,0,0,300,0,40,90\n"
    (message,), _ = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "person", SIZES)
    low, high = message.detections
    assert (list(low.head), list(low.foot)) == ([120.0, 600.0], [])
    assert (list(high.head), list(high.foot)) == ([], [320.0, 90.0])


def test_of_a_box_that_the_border_cuts_the_middle_is_uncertain(tmp_path: Path) -> None:
    """It counted as the middle of the body to 1.5 px, and positions near the border were 0.1 m off at stds of 0.04 m.

    At a side head and foot are not given either: the middle of what is seen is not above them.
    """
    width, height = SIZE
    boxes = ((100, 600, 40, height - 600), (0, 200, 30, 160), (width - 20, 200, 20, 160), (500, 200, 60, 160))
    text = BOXES + "".join(f"left,0,0,{x},{y},{w},{h}\n" for x, y, w, h in boxes)
    (message,), _ = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "person", SIZES)
    low, left, right, whole = message.detections
    assert [low.covariance[2] ** 0.5 > 0.4 * (height - 600), low.covariance[0] ** 0.5] == [True, 1.5]
    for one in (left, right):
        assert not one.head
        assert not one.foot
        assert 10.0 < one.covariance[0] ** 0.5 < 40.0
        assert one.covariance[2] ** 0.5 == 1.5
    assert not whole.covariance
    assert len(whole.foot) == 2


def test_of_a_vehicles_box_that_the_border_cuts_the_middle_is_uncertain(tmp_path: Path) -> None:
    """It counted as the vehicle's middle to 1.5 px: paths along the border were 5 m off at stds of 0.3 m."""
    height = SIZE[1]
    boxes = ((100, height - 50, 90, 50), (0, 200, 30, 60), (500, 200, 90, 60))
    text = BOXES + "".join(f"left,0,0,{x},{y},{w},{h}\n" for x, y, w, h in boxes)
    (message,), _ = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "vehicle", SIZES)
    low, left, whole = message.detections
    assert [low.covariance[0] ** 0.5, low.covariance[2] ** 0.5 > 70.0] == [1.5, True]
    assert [left.covariance[0] ** 0.5 > 50.0, left.covariance[2] ** 0.5] == [True, 1.5]
    assert not whole.covariance
    assert not low.head


@pytest.mark.parametrize(("unit", "warned"), [("m", False), ("cm", True)])
def test_vehicles_of_a_size_that_none_has_are_warned_of(tmp_path: Path, unit: str, warned: bool) -> None:
    """With a calibration in metres that says cm, places were 100 times as near as they are, without a word."""
    file = write_calibration(tmp_path / "calibration.toml")
    file.write_text(file.read_text(encoding="utf-8").replace('units = "m"', f'units = "{unit}"'), encoding="utf-8")
    known = read_given_calibration(file)
    text = BOXES + "left,0,0.5,400,300,90,60\n"
    messages, _ = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "vehicle", SIZES)
    one, place = np.ones(1), np.zeros((1, 3))
    track = FollowedTrack(1, "vehicle", one, place, one, one, one > 0.0, (("left", 0, 0),))
    warnings = units.unlikely_size([track], messages, known)
    assert [" m in size: are the calibration's positions in its units" in text for text in warnings] == [True] * warned


@pytest.mark.parametrize("late", [0.0, 3.0, -5.0])
def test_vehicles_that_fit_at_another_lag_are_warned_of(tmp_path: Path, late: float) -> None:
    """Videos of another day begin at other times: tracks were made of rays to different vehicles, without a word."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml", offsets={NAMES[1]: late}))
    text = BOXES
    for frame in range(300):
        for name, pose in poses().items():
            for u, v in crowds.lens().project(pose.camera_from_world(np.c_[crowds.places(0.1 * frame), np.ones(3)])):
                text += f"{name},{frame},{0.1 * frame},{u - 10},{v - 10},20,20\n"
    messages, _ = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "vehicle", SIZES)
    warnings = units.check_units(messages, known, "vehicle", tmp_path)
    assert bool(warnings) == bool(late)
    for text in warnings:
        added = float(text.split(" with about ")[1].split(" s ")[0])
        assert added == pytest.approx(-late if text.startswith(NAMES[1]) else late, abs=0.3)


@pytest.mark.parametrize("late", [0.0, 0.2, 1.4, -3.0])
def test_people_who_meet_at_another_lag_are_warned_of(tmp_path: Path, late: float) -> None:
    """Of a room followed with the clocks of another recording, four people became ten tracks without a word."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml", offsets={NAMES[1]: late}))
    warnings = read_follow_input(rows(tmp_path, boxes_csv(30.0)), known, "person", tmp_path).warnings
    if abs(late) < 1.0:
        assert warnings == ()
        return
    (warning,) = [one for one in warnings if "time_offset" in one]
    assert warning.startswith(f"{NAMES[1]}: its people fit those of {NAMES[0]}, {NAMES[2]} with about {-late:+.1f} s")


@pytest.mark.parametrize("degrees", [0.0, 0.3, -4.0, 15.0])
@pytest.mark.parametrize("name", NAMES)
def test_a_camera_that_was_turned_is_named(tmp_path: Path, name: str, degrees: float) -> None:
    """A turn by 5° made thirteen tracks of four people without a word."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    camera = known.calibration.cameras[name]
    turned = Pose(camera.pose.rotation @ so3.exp(np.radians(degrees) * np.array([0.0, 0.6, 0.8])), camera.pose.position)
    cameras = {**known.calibration.cameras, name: replace(camera, pose=turned)}
    known = replace(known, calibration=replace(known.calibration, cameras=cameras))
    warnings = read_follow_input(rows(tmp_path, boxes_csv(30.0)), known, "person", tmp_path).warnings
    others = ", ".join(one for one in NAMES if one != name)
    said = rf"{name}: its people are [0-9.]+ m \(([0-9.]+)°\) off those of {others}: it was turned or moved since"
    found = [float(match[1]) for one in warnings if (match := re.match(said, one))]
    assert len(warnings) == len(found) == (abs(degrees) > 1.0)
    assert all(0.5 * abs(degrees) < one < 1.1 * abs(degrees) for one in found)


@pytest.mark.parametrize("metres", [0.02, 0.5])
def test_of_two_cameras_the_one_that_was_moved_is_not_known(tmp_path: Path, metres: float) -> None:
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    two = {name: known.calibration.cameras[name] for name in NAMES[:2]}
    pose = two[NAMES[1]].pose
    two[NAMES[1]] = replace(two[NAMES[1]], pose=replace(pose, position=pose.position + metres * pose.rotation[0]))
    known = replace(known, calibration=replace(known.calibration, cameras=two))
    text = "".join(line for line in boxes_csv(30.0).splitlines(True) if not line.startswith(NAMES[2]))
    warnings = read_follow_input(rows(tmp_path, text), known, "person", tmp_path).warnings
    assert ["off each other: one of them was turned or moved" in one for one in warnings] == [True] * (metres > 0.1)


def test_boxes_beyond_the_border_are_not_cut_there(tmp_path: Path) -> None:
    text = BOXES + f"left,0,0,100,600,40,{SIZE[1] - 600}\nleft,0,0,300,-30,40,90\n"
    (message,), _ = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "person", SIZES)
    assert [len(one.foot) for one in message.detections] == [2, 2]


def test_rows_of_head_and_foot_are_one_person(tmp_path: Path) -> None:
    text = (
        "camera,frame,time,u,v,label\n"
        "left,3,0.1,50,20,ann-head\nleft,3,0.1,52,90,ann-foot\nleft,3,0.1,80,30,bob-head\nleft,3,0.1,9,9,marker\n"
    )
    (message,), left = followed_detections(object_messages(read_objects(rows(tmp_path, text), SIZES)), "person", SIZES)
    (one,) = message.detections
    assert (list(one.head), list(one.foot), one.label) == ([50.0, 20.0], [52.0, 90.0], "")
    assert (one.u, one.v) == (51.0, 55.0)
    assert left.counts.total() == 2


def test_other_kinds_are_left_out(tmp_path: Path) -> None:
    text = (
        "camera,frame,time,u,v,kind,box_x,box_y,box_w,box_h\n"
        "left,0,0,50,60,vehicle,10,10,80,80\nleft,0,0,50,60,person,10,10,80,80\nleft,0,0,50,60,marker,,,,\n"
    )
    messages = object_messages(read_objects(rows(tmp_path, text), SIZES))
    for kind, ends_given in (("person", 2), ("vehicle", 0)):
        (message,), left = followed_detections(messages, kind, SIZES)  # type: ignore[arg-type]
        assert [(one.kind, len(one.foot)) for one in message.detections] == [(kind, ends_given)]
        assert left.counts.total() == 2


def test_frames_without_a_row_say_that_nobody_was_seen(tmp_path: Path) -> None:
    lines = "".join(f"left,{frame},{0.2 * frame},100,200,40,160\n" for frame in (2, 4, 10, 12))
    messages = object_messages(read_objects(rows(tmp_path, BOXES + lines), SIZES))
    assert [message.sequence for message in messages] == [2, 4, 6, 8, 10, 12]
    assert [len(message.detections) for message in messages] == [1, 1, 0, 0, 1, 1]
    assert messages[3].device_time_ns == pytest.approx(1.6e9)


def test_numbers_that_are_only_labels_add_no_frames(tmp_path: Path) -> None:
    lines = "".join(f"left,{frame},{time},100,200,40,160\n" for time, frame in enumerate((1, 10**15, 3 * 10**15)))
    assert len(object_messages(read_objects(rows(tmp_path, BOXES + lines), SIZES))) == 3


def test_rows_are_wanted_at_the_reference_cameras_frames_or_at_a_rate(tmp_path: Path) -> None:
    source = read(tmp_path, boxes_csv(2.0, 5.0))
    assert source.times_ns == [round(2e8 * frame) for frame in range(10)]
    assert read(tmp_path, boxes_csv(2.0, 5.0), fps=10.0).times_ns == [round(1e8 * index) for index in range(19)]
    with pytest.raises(InputError, match="--fps"):
        read(tmp_path, boxes_csv(2.0, 5.0) + "left,99999,39999,100,200,40,160\n", fps=1000.0)


def test_lags_of_the_calibration_are_applied(tmp_path: Path) -> None:
    offsets = {"left": 10.0, "right": -3.0}
    (tmp_path / "boxes.csv").write_text(boxes_csv(2.0, 5.0, offsets), encoding="utf-8")
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml", offsets=offsets))
    source = read_follow_input(tmp_path, known, "person", tmp_path)
    assert source.times_ns[0] == 0
    assert source.frame_times(known)[1] == pytest.approx(0.2)


def test_a_time_that_is_a_clock_step_away_is_left_out_by_name(tmp_path: Path) -> None:
    """One such row had all people refused."""
    lines = [f"{camera},{frame},{frame / 10},100,200,40,160\n" for camera in ("left", "right") for frame in range(5)]
    source = read(tmp_path, BOXES + "".join(lines) + "left,5,1e9,100,200,40,160\n")
    assert [message.camera for message in source.observations].count("left") == 5
    warning, _ = source.warnings
    assert warning == "left: its clock steps by +999999999.6 s; 1 of 6 frames on the other side are left out"


def test_a_row_that_is_there_twice_is_one_person(tmp_path: Path) -> None:
    text = boxes_csv(2.0, 5.0)
    source = read(tmp_path, text + text.split("\n", 1)[1])
    assert sum(len(one.detections) for one in source.observations) == text.count("\n") - 1
    assert source.warnings == (f"{text.count(chr(10)) - 1} rows left out: the same as another of its frame",)


def test_cameras_without_a_common_time_are_named(tmp_path: Path) -> None:
    """Such a camera was followed in alone without a word, and three of them ended the command with a traceback."""
    offsets = {"left": 0.0, "right": 500.0, "back": 0.0}
    (warning,) = read(tmp_path, boxes_csv(2.0, 5.0, offsets)).warnings
    assert warning.startswith("right has frames from -499.9 to -498.1 s of the reference clock, all others from 0.0")
    with pytest.raises(Refused, match="no two cameras have a time in common: left has frames from"):
        read(tmp_path, boxes_csv(2.0, 5.0, offsets | {"back": 2e5}))


def test_boxes_without_heights_are_asked_for_heights_not_for_points(tmp_path: Path) -> None:
    error = bad(tmp_path, "camera,frame,time,x,y,width\nleft,0,0,100,200,40\n")
    assert "column height is missing" in str(error)


def bad(folder: Path, text: str) -> InputError:
    with pytest.raises(InputError) as caught:
        read(folder, text)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("left,1,0.2,5000,200,40,160", "outside the 960x720 picture"),
        ("left,1,0.2,100,-900,40,160", "outside the 960x720 picture"),
        ("left,1,0.2,100,200,40,-160", "its foot is not below its head"),
        ("left,1,0.2,100,200,-40,160", "its right side is not right of its left"),
        ("left,1,0.2,100,nan,40,160", "y 'nan' is not a number"),
        ("left,1,0.2,100,,40,160", "y '' is not a number"),
        ("left,1,soon,100,200,40,160", "time 'soon' is not a number"),
        ("left,1,1e18,100,200,40,160", "time '1e18' is not a number up to 9e+09"),
        ("left,1.5,0.2,100,200,40,160", "frame 1.5 is not a whole number"),
        ("loft,1,0.2,100,200,40,160", "camera 'loft' is not in the calibration (left, right, back)"),
        ("left,1,0.2,100", "4 columns where the first line has 7"),
    ],
)
def test_a_bad_row_is_named_with_its_line(row: str, what: str, tmp_path: Path) -> None:
    error = bad(tmp_path, BOXES + f"left,0,0,100,200,40,160\n{row}\n")
    assert what in str(error)
    assert error.line == 3
    assert error.file is not None
    assert error.remedy


@pytest.mark.parametrize(("u", "head_u", "what"), [(9000, 50, "u, v lies"), (50, 5000, "the head lies")])
def test_a_person_outside_the_picture_is_named_with_its_line(u: int, head_u: int, what: str, tmp_path: Path) -> None:
    text = f"camera,frame,time,u,v,head_u,head_v,foot_u,foot_v\nleft,0,0,{u},50,{head_u},30,50,90\n"
    with pytest.raises(InputError, match=f"rows.csv:2: {what} outside the 960x720 picture"):
        read_objects(rows(tmp_path, text), SIZES)


def test_a_head_below_its_foot_is_named_with_its_line(tmp_path: Path) -> None:
    text = "camera,frame,time,u,v,label\nleft,0,0,50,90,ann-head\nleft,0,0,52,20,ann-foot\n"
    with pytest.raises(InputError, match=r"rows.csv:3: ann: the head is not above the foot"):
        read_objects(rows(tmp_path, text), SIZES)
    ceiling = text + "left,1,1,50,20,ann-head\nleft,1,1,52,90,ann-foot\n"
    assert len(read_objects(rows(tmp_path, ceiling), SIZES)) == 4


def test_boxes_of_cameras_that_look_down_are_what_may_be_wrong(tmp_path: Path) -> None:
    """Where nobody was found in them, calibration and clocks were suspected alone."""
    file = write_calibration(tmp_path / "calibration.toml")
    messages = object_messages(read_objects(rows(tmp_path, boxes_csv(1.0)), SIZES))
    assert units.boxes_from_above(messages, read_given_calibration(file)) == ""
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    down = Pose(look_at_pose(np.array([0.01, 0.0, 5.0]), np.zeros(3)).rotation, np.array([0.01, 0.0, 5.0]))
    tables["left"] |= {"rotation": down.rodrigues.tolist(), "translation": down.translation.tolist()}
    file.write_text(tomli_w.dumps(tables), encoding="utf-8")
    assert "look down steeply (left)" in units.boxes_from_above(messages, read_given_calibration(file))


@pytest.mark.parametrize("scale", [0.001, 100.0, 1000.0, 3.281, 39.37])
def test_a_calibration_in_other_units_is_refused(scale: float, tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_text(boxes_csv(3.0), encoding="utf-8")
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml", scale=scale))
    with pytest.raises(
        InputError, match=r"calibration.toml:2: the cameras' positions are about .* times too"
    ) as caught:
        read_follow_input(tmp_path, known, "person", tmp_path)
    assert f"{max(scale, 1.0 / scale):.4g} times too {'large' if scale > 1.0 else 'small'}" in str(caught.value)


@pytest.mark.parametrize("convention", POSE_CONVENTIONS)
@pytest.mark.parametrize("up", ["given", "left out", "left"])
def test_another_convention_of_poses_is_named(convention: str, up: str, tmp_path: Path) -> None:
    """They were followed as a few tracks of nobody, or refused as other units, clocks or cameras."""
    (tmp_path / "boxes.csv").write_text(boxes_csv(3.0), encoding="utf-8")
    tables = tomllib.loads(write_calibration(tmp_path / "calibration.toml").read_text(encoding="utf-8"))
    turn = look_at_pose(np.zeros(3), np.array([3.0, 4.0, 1.0])).rotation  # else two of the conventions are one
    tables["metadata"]["up"] = turn.T[:, 2].tolist() if up == "given" else up
    if up == "left out":
        del tables["metadata"]["up"]
    for name in NAMES:
        meant = Pose(poses()[name].rotation @ turn, turn.T @ poses()[name].position)
        written = _WRITTEN[convention](meant)
        tables[name] |= {"rotation": written.rodrigues.tolist(), "translation": written.translation.tolist()}
    (tmp_path / "calibration.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    known = read_given_calibration(tmp_path / "calibration.toml")
    with pytest.raises(InputError, match=rf"people meet at one place if in the calibration {convention};"):
        read_follow_input(tmp_path, known, "person", tmp_path)


@pytest.mark.parametrize("up", [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
def test_another_vertical_is_named(up: list[float], tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_text(boxes_csv(3.0), encoding="utf-8")
    known = replace(read_given_calibration(write_calibration(tmp_path / "calibration.toml")), up=np.array(up))
    with pytest.raises(
        InputError, match=r"toml:5: `up` is not the vertical .* who stand along \[.*, 1\.00\] in the wor"
    ):
        read_follow_input(tmp_path, known, "person", tmp_path)


def test_a_calibrated_camera_without_frames_is_named(tmp_path: Path) -> None:
    text = "".join(line for line in boxes_csv().splitlines(keepends=True) if not line.startswith(NAMES[-1]))
    assert read(tmp_path, boxes_csv()).warnings == ()
    assert read(tmp_path, text).warnings == (f"{NAMES[-1]}: calibrated, but no frame of it is here",)


def test_nobody_is_a_refusal(tmp_path: Path) -> None:
    text = "camera,frame,time,u,v,kind\nleft,0,0,50,60,marker\n"
    with pytest.raises(Refused, match="no person in any frame; 1 rows left out: of kind marker"):
        read(tmp_path, text)


def test_ends_of_the_made_up_people_are_in_every_picture() -> None:
    for name in NAMES:
        for time in np.linspace(0.0, 8.0, 9):
            for end in ends(name, float(time)):
                assert ((end > 0.0) & (end < SIZE)).all()


@pytest.mark.parametrize(
    ("boxes", "what"),
    [
        (
            lambda x, y, w, h: (x / 2, y / 2, w / 2, h / 2),
            "its pixels are about 2 times too small for the cal",
        ),
        (lambda x, y, w, h: (x / 1.5, y / 1.5, w / 1.5, h / 1.5), r"about 1\.5 times too small .* \(left: 960x720\)"),
        (lambda x, y, w, h: (x, y, w, h / 2), r"its people are about 2 times too small for 1\.7 m from head to foot"),
        (lambda x, y, w, h: (x + w / 4, y + h / 4, w / 2, h / 2), "its people are about 2 times too small"),
        (lambda x, y, w, h: (x, y, x + w, y + h), "boxes.csv:2: width and height look like the right and the lower"),
        (lambda x, y, w, h: (x / 960, y / 720, w / 960, h / 720), "all boxes are within 0 to 1: fractions of the pict"),
    ],
)
@pytest.mark.parametrize("up", [True, False])
def test_boxes_of_other_pictures_or_of_half_bodies_are_named(
    boxes: Callable[..., tuple[float, ...]], what: str, up: bool, tmp_path: Path
) -> None:
    """They became dozens of tracks of nobody without a word."""
    header, *lines = boxes_csv(3.0).splitlines()
    cells = [line.split(",") for line in lines]
    text = "\n".join([header, *(",".join([*c[:3], *map(str, boxes(*map(float, c[3:])))]) for c in cells)])
    (tmp_path / "boxes.csv").write_text(text + "\n", encoding="utf-8")
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    with pytest.raises(InputError, match=what):
        read_follow_input(tmp_path, known if up else replace(known, up=None), "person", tmp_path)


@pytest.mark.parametrize("camera", NAMES)
def test_swapped_widths_and_heights_are_named(camera: str, tmp_path: Path) -> None:
    """Whichever way the camera looks."""
    header, *lines = boxes_csv(3.0).splitlines()
    swapped = [",".join([*(c := line.split(","))[:5], c[6], c[5]]) for line in lines if line.startswith(camera)]
    assert "most boxes are wider than high" in str(bad(tmp_path, "\n".join([header, *swapped])))


def test_one_cameras_fractions_are_named(tmp_path: Path) -> None:
    """Its rows were nobody's, without a word."""
    header, *lines = boxes_csv(3.0).splitlines()
    cells = [line.split(",") for line in lines]
    text = [",".join([*c[:3], *(str(float(v) / 1000) for v in c[3:])] if c[0] == "back" else c) for c in cells]
    error = bad(tmp_path, "\n".join([header, *text]))
    assert "back: all boxes are within 0 to 1" in str(error)
    assert error.line is not None
    assert text[error.line - 2].startswith("back,0,")


def test_middles_of_boxes_are_named_where_people_walk_out_on_the_right(tmp_path: Path) -> None:
    """Of a detector that cuts boxes at the picture's border; x and y of its top left are nowhere beyond it."""
    boxes = [(x, 300.0, min(40.0, 960.0 - x), 160.0) for x in (*np.linspace(0, 900, 48), *np.linspace(922, 950, 12))]
    corners = [f"left,{i},{i},{x},{y},{w},{h}" for i, (x, y, w, h) in enumerate(boxes)]
    middles = [f"left,{i},{i},{x + w / 2},{y + h / 2},{w},{h}" for i, (x, y, w, h) in enumerate(boxes)]
    assert len(read_objects(rows(tmp_path, "\n".join([BOXES.strip(), *corners])), SIZES)) == 60
    assert "x and y look like the middle" in str(bad(tmp_path, "\n".join([BOXES.strip(), *middles])))


@pytest.mark.parametrize(
    "boxes",
    [
        [(921.0, 300.0, 40.0, 160.0)] * 40 + [(300.0, 300.0, 40.0, 160.0)] * 40,
        [(450.0 + 3.0 * i, 300.0, 60.0, 160.0) for i in range(160)],
        [(200.0, 50.0, 500.0, 700.0)] * 40,
    ],
    ids=["numbered from 1", "not cut at the border", "one who stands close"],
)
def test_good_boxes_at_the_border_are_taken(boxes: list[tuple[float, ...]], tmp_path: Path) -> None:
    lines = [f"left,{i},{i / 10},{x},{y},{w},{h}" for i, (x, y, w, h) in enumerate(boxes)]
    lines += [f"right,{i},{i / 10},400,300,40,160" for i in range(40)]
    assert len(read_objects(rows(tmp_path, "\n".join([BOXES.strip(), *lines])), SIZES)) == len(lines)


def test_a_camera_that_seldom_sees_anybody_is_followed_in(tmp_path: Path) -> None:
    lines = [f"left,{i},{i / 10},{400 + 5 * i},300,60,160" for i in range(40)]
    lines += ["right,10,1.0,400,300,60,160", "right,220,22.0,400,300,60,160"]
    assert read(tmp_path, "\n".join([BOXES.strip(), *lines])).observations


def test_times_that_several_frames_share_are_named(tmp_path: Path) -> None:
    """They became one frame with everybody several times: 22 tracks of 4 people."""
    header, *lines = boxes_csv(3.0).splitlines()
    cells = [line.split(",") for line in lines]
    whole = [",".join([*c[:2], str(int(float(c[2]))), *c[3:]]) for c in cells]
    assert "15 frames of left have 3 different times" in str(bad(tmp_path, "\n".join([header, *whole])))


@pytest.mark.parametrize("unit", [1e3, 1e6])
def test_times_in_another_unit_are_named(unit: float, tmp_path: Path) -> None:
    """128 tracks of 5 people in 5800 s, or none."""
    header, *lines = boxes_csv(3.0).splitlines()
    cells = [line.split(",") for line in lines]
    other = [",".join([*c[:2], str(unit * float(c[2])), *c[3:]]) for c in cells]
    assert "give times in seconds" in str(bad(tmp_path, "\n".join([header, *other])))


def test_boxes_of_another_kind_are_left_out_and_other_columns_of_a_boxes_file_are_asked_for(tmp_path: Path) -> None:
    header, *lines = boxes_csv(3.0).splitlines()
    kinds = [f"{line},{'vehicle' if index % 3 else 'person'}" for index, line in enumerate(lines)]
    source = read(tmp_path, "\n".join([f"{header},kind", *kinds]))
    assert sum(len(one.detections) for one in source.observations) == len(lines) / 3
    error = bad(tmp_path, "camera,frame,time,left,top,w,h\nleft,0,0,1,2,3,4\n")
    assert error.remedy == "the first line must name camera,frame,time,x,y,width,height"


def test_people_who_meet_nowhere_are_a_warning(tmp_path: Path) -> None:
    """As from pictures that a detector squeezed into squares."""
    header, *lines = boxes_csv(8.0).splitlines()
    cells = [line.split(",") for line in lines]
    squeezed = [",".join([*c[:3], str(0.4 * float(c[3])), c[4], str(0.4 * float(c[5])), c[6]]) for c in cells]
    (warning,) = read(tmp_path, "\n".join([header, *squeezed])).warnings
    assert re.match(r"of \d+ people whom one camera sees where others look, others see \d+ there", warning)
    assert read(tmp_path, boxes_csv(8.0)).warnings == ()


def test_looking_for_people_who_meet_takes_no_table_of_all_by_all(tmp_path: Path) -> None:
    """Of 60 frames with 40 people in each of 5 cameras it took 200 MB."""
    known = read_given_calibration(write_calibration(tmp_path / "calibration.toml"))
    names, count = list(known.calibration.cameras), 6_000
    rng = np.random.default_rng(0)
    bodies = units._Bodies(
        np.repeat(np.arange(60.0) * 1e9, count // 60), np.arange(count) % len(names), rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)), np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    tracemalloc.start()
    try:
        units._nowhere(bodies, list(known.calibration.cameras.values()), 1.7)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


def test_children_alone_are_named_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Picture sizes, poses, time offsets and units were in doubt though everybody was followed."""
    monkeypatch.setattr(crowds, "HEIGHT", 1.1)
    (warning,) = read(tmp_path, boxes_csv(8.0)).warnings
    assert warning.startswith("the people seem to be about 1.1 m tall: of children, or people seated")


def test_cameras_on_high_poles_are_no_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From 14 m a body's breadth makes boxes so much longer that no camera alone gives a place.

    They were a warning, and refused as of other poses where people came nearer to each other along another vertical.
    """
    monkeypatch.setattr(crowds, "_STANDS", ((-7.0, -6.0, 14.0), (7.0, -6.5, 14.0), (0.5, 8.0, 14.0)))
    monkeypatch.setattr(crowds, "_FOCAL", 400.0)
    header, *lines = boxes_csv(8.0).splitlines()
    cells = [line.split(",") for line in lines]
    longer = [",".join([*c[:6], str(1.5 * float(c[6]))]) for c in cells]
    assert read(tmp_path, "\n".join([header, *longer])).warnings == ()
    # Large false boxes alone seem near enough for a place.
    places = np.random.default_rng(0).uniform((0.0, 0.0, 80.0), (900.0, 520.0, 200.0), (len(cells) // 4, 3))
    false = [",".join([*c[:3], f"{x},{y},{0.3 * h},{h}"]) for c, (x, y, h) in zip(cells[::4], places, strict=True)]
    assert read(tmp_path, "\n".join([header, *longer, *false])).warnings == ()


def _broad_ends(name: str, time: float) -> tuple[Floats, Floats]:
    """Middles of the top and of the bottom of boxes around cylinders of 0.5 m."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24)
    around = 0.25 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(24)])
    rings = np.concatenate([around, around + [0.0, 0.0, crowds.HEIGHT]])
    points = np.hstack([crowds.places(time), np.zeros((3, 1))])[:, None] + rings
    pixels = crowds.lens().project(poses()[name].camera_from_world(points.reshape(-1, 3))).reshape(3, -1, 2)
    top, bottom = pixels.min(axis=1), pixels.max(axis=1)
    middle = 0.5 * (top + bottom)
    return np.column_stack([middle[:, 0], top[:, 1]]), np.column_stack([middle[:, 0], bottom[:, 1]])


@pytest.mark.parametrize(
    "stands",
    [
        ((-7.0, 0.0, 9.0), (7.0, 0.0, 4.0)),
        ((-7.0, -6.0, 5.0), (7.0, -6.5, 4.0), (0.5, 8.0, 6.0)),
    ],
)
def test_cameras_that_look_down_on_bodies_of_some_breadth_are_no_warning(
    stands: tuple[tuple[float, float, float], ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each put people nearer to itself than they are: poses were doubted, or a camera was said to be turned."""
    monkeypatch.setattr(crowds, "_STANDS", stands)
    monkeypatch.setattr(crowds, "NAMES", NAMES[: len(stands)])
    monkeypatch.setattr(crowds, "ends", _broad_ends)
    assert read(tmp_path, boxes_csv(12.0)).warnings == ()


def test_a_camera_whose_time_offset_is_years_off_is_left_out_by_name(tmp_path: Path) -> None:
    """Where two such cameras and two others were followed, their matrices became singular: a traceback."""
    source = read(tmp_path, boxes_csv(3.0, 5.0, {"left": 0.0, "right": 0.0, "back": 1.7e9}))
    assert {message.camera for message in source.observations} == {"left", "right"}
    (warning,) = source.warnings
    assert warning.startswith("back: left out, its frames are 1700000000 s from the others' by the calibration's time")
