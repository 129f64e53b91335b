"""All columns of observations.csv, row by row: people without identities, and values that contradict each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protocols.core.errors import InputError
from protocols.session.observations import DetectionRows, read_detections

HEADER = "camera,frame,time,u,v,score,kind,cov_uu,cov_uv,cov_vv,head_u,head_v,foot_u,foot_v,box_x,box_y,box_w,box_h"
PERSON = "a,0,0.5,100,80,0.9,person,4,1,9,100,40,101,140,80,40,40,100"


def read(folder: Path, *rows: str, header: str = HEADER) -> DetectionRows:
    file = folder / "observations.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    return read_detections(file, {"a": (640, 480), "b": (320, 240)})


def test_two_people_of_one_instant_are_two_rows_and_empty_cells_are_not_seen(tmp_path: Path) -> None:
    found = read(tmp_path, PERSON, "a,0,0.5,300,90,,,,,,,,,,,,,")
    assert len(found) == 2
    assert (found.camera, found.kind, found.label) == (["a", "a"], ["person", ""], ["marker", "marker"])
    assert found.score[0] == 0.9
    assert found.covariance[0].tolist() == [4.0, 1.0, 9.0]
    assert (found.head[0].tolist(), found.foot[0].tolist()) == ([100.0, 40.0], [101.0, 140.0])
    assert found.box[0].tolist() == [80.0, 40.0, 40.0, 100.0]
    missing = (found.score, found.covariance, found.head, found.foot, found.box)
    assert all(bool(np.isnan(column[1]).all()) for column in missing)


def test_the_short_form_of_the_file_is_read_too(tmp_path: Path) -> None:
    found = read(tmp_path, "b,3,1.5,10,20", header="camera,frame,time,u,v")
    assert found.kind == [""]
    assert found.pixels.tolist() == [[10.0, 20.0]]
    assert np.isnan(found.box).all()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"score": "1.5"}, "score 1.5 is beyond"),
        ({"score": "-0.1"}, "score -0.1 is negative"),
        ({"score": "nan"}, "score is nan"),
        ({"score": "high"}, "'high' is not a number"),
        ({"kind": "dog"}, "kind 'dog' is not known"),
        ({"cov_uv": "7"}, "no covariance"),
        ({"cov_uu": ""}, "cov_uu is empty; give all of cov_uu, cov_uv, cov_vv, or none"),
        ({"head_v": ""}, "head_v is empty"),
        ({"head_v": "1e7"}, "beyond"),
        ({"box_w": "0"}, "a box of 0 x 100 px"),
        ({"box_x": "640"}, "outside the 640x480 image"),
        ({"box_y": "inf"}, "box_y is inf"),
        ({"camera": "c"}, "camera 'c' is not in the rig"),
    ],
)
def test_a_bad_value_is_one_line_with_its_place(tmp_path: Path, changed: dict[str, str], message: str) -> None:
    cells = dict(zip(HEADER.split(","), PERSON.split(","), strict=True)) | changed
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, PERSON, ",".join(cells.values()))
    assert caught.value.line == 3
    assert "\n" not in str(caught.value)


def test_heads_that_are_below_their_feet_are_named_with_the_line_of_the_first(tmp_path: Path) -> None:
    swapped = dict(zip(HEADER.split(","), PERSON.split(","), strict=True)) | {"head_v": "200"}
    with pytest.raises(InputError, match="the head is not above the foot") as caught:
        read(tmp_path, *[",".join(swapped.values())] * 2)
    assert caught.value.line == 2


def test_below_a_ceiling_camera_some_heads_are_below_their_feet(tmp_path: Path) -> None:
    """A hall with cameras on the ceiling was refused: "the head is not above the foot"."""
    away = dict(zip(HEADER.split(","), PERSON.split(","), strict=True)) | {"head_v": "200"}
    assert len(read(tmp_path, PERSON, ",".join(away.values()))) == 2


def test_one_swapped_camera_among_others_is_named(tmp_path: Path) -> None:
    away = dict(zip(HEADER.split(","), PERSON.split(","), strict=True)) | {"head_v": "200", "camera": "b"}
    with pytest.raises(InputError, match="the head is not above the foot") as caught:
        read(tmp_path, *[PERSON] * 30, *[",".join(away.values())] * 2)
    assert caught.value.line == 32


def test_a_camera_on_its_side_has_its_heads_beside_the_feet(tmp_path: Path) -> None:
    cells = dict(zip(HEADER.split(","), PERSON.split(","), strict=True))
    cells |= {"head_u": "40", "head_v": "91", "foot_u": "140", "foot_v": "90"}
    assert len(read(tmp_path, ",".join(cells.values()))) == 1
