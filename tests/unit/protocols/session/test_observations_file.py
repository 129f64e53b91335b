"""observations.csv: any row order, extra columns, and each mistake reported with file, line, what and remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from protocols.core.errors import InputError
from protocols.session.folder import write_observations
from protocols.session.observations import DEFAULT_LABEL, Observations, gather_tracks, read_observations
from tests.support import command_line

HEAD = "camera,frame,time,u,v\n"
ROWS = "a,0,10.0,1.5,2.5\na,1,10.1,3,4\nb,0,1.7e9,5,6\n"


def read(tmp_path: Path, text: str | bytes) -> Observations:
    file = tmp_path / "observations.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_observations(file, ["a", "b"])


def assert_reported(tmp_path: Path, text: str | bytes, line: int | None, *words: str) -> None:
    command_line.assert_reported(lambda: read(tmp_path, text), tmp_path / "observations.csv", line, *words)


def same(one: Observations, other: Observations) -> bool:
    return list(one.tracks) == list(other.tracks) and all(
        np.array_equal(getattr(a, key), getattr(b, key), equal_nan=True)
        for a, b in zip(one.tracks.values(), other.tracks.values(), strict=True)
        for key in ("frame", "time", "pixels", "size")
    )


def test_rows_become_tracks(tmp_path: Path) -> None:
    seen = read(tmp_path, HEAD + ROWS)
    assert list(seen.tracks) == [("a", DEFAULT_LABEL), ("b", DEFAULT_LABEL)]
    track = seen.tracks["a", DEFAULT_LABEL]
    np.testing.assert_array_equal(track.time, [10.0, 10.1])
    np.testing.assert_array_equal(track.pixels, [[1.5, 2.5], [3, 4]])
    np.testing.assert_array_equal(track.frame, [0, 1])
    assert np.isnan(track.size).all()
    assert (len(seen), seen.cameras, seen.labels) == (3, ["a", "b"], [DEFAULT_LABEL])


def test_time_keeps_every_digit(tmp_path: Path) -> None:
    seen = read(tmp_path, HEAD + "a,0,1700000000.1234567,1,2\na,1,1700000000.1234570,1,2\n")
    assert seen.tracks["a", DEFAULT_LABEL].time[0] == 1700000000.1234567
    assert len(seen.tracks["a", DEFAULT_LABEL]) == 2


def test_columns_may_come_in_any_order_with_extra_ones(tmp_path: Path) -> None:
    text = "note,v,u,time,frame,camera,score\nx,2.5,1.5,10.0,0,a,\ny,4,3,10.1,1,a,nan\nz,6,5,1.7e9,0,b,?\n"
    assert same(read(tmp_path, text), read(tmp_path, HEAD + ROWS))


def test_spaces_around_names_do_no_harm(tmp_path: Path) -> None:
    text = "camera, frame, time, u, v\na, 0, 10.0, 1.5, 2.5\na, 1, 10.1, 3, 4\nb ,0, 1.7e9, 5, 6\n"
    assert same(read(tmp_path, text), read(tmp_path, HEAD + ROWS))


@pytest.mark.parametrize(
    "variant",
    [
        b"\xef\xbb\xbf" + (HEAD + ROWS).encode(),
        (HEAD + ROWS).replace("\n", "\r\n").encode(),
        (HEAD + ROWS).rstrip("\n").encode(),
        (HEAD + "\n" + ROWS + "\n\n").encode(),
        (HEAD + ROWS.replace("a,", '"a",')).encode(),
    ],
    ids=["byte order mark", "CRLF", "no last newline", "empty lines", "quotes"],
)
def test_the_file_may_come_from_any_program(tmp_path: Path, variant: bytes) -> None:
    assert same(read(tmp_path, variant), read(tmp_path, HEAD + ROWS))


def test_lines_of_blanks_are_empty_lines(tmp_path: Path) -> None:
    assert same(read(tmp_path, HEAD + "  \n" + ROWS + " , , , , \n"), read(tmp_path, HEAD + ROWS))


def test_a_size_of_zero_or_nothing_is_not_measured(tmp_path: Path) -> None:
    text = "camera,frame,time,u,v,size\na,0,0,1,1,0\na,1,1,1,1,\na,2,2,1,1,7.5\n"
    np.testing.assert_array_equal(read(tmp_path, text).tracks["a", DEFAULT_LABEL].size, [np.nan, np.nan, 7.5])


def test_a_label_left_empty_is_the_default(tmp_path: Path) -> None:
    text = "camera,frame,time,u,v,label\na,0,0,1,1,red\na,0,0,2,2,\n"
    assert set(read(tmp_path, text).labels) == {"red", DEFAULT_LABEL}


def test_two_labels_may_share_a_frame(tmp_path: Path) -> None:
    text = "camera,frame,time,u,v,label\na,0,0,1,1,red\na,0,0,2,2,blue\n"
    assert len(read(tmp_path, text).of_camera("a")) == 2


def test_negative_times_are_times(tmp_path: Path) -> None:
    track = read(tmp_path, HEAD + "a,1,-1.5,1,2\na,0,-2.5,3,4\n").tracks["a", DEFAULT_LABEL]
    np.testing.assert_array_equal(track.time, [-2.5, -1.5])


_table = [
    f"{camera},{frame},{frame / 10},{frame * 3.5 + index},{frame % 7},{frame % 3 * 2.0},{label}"
    for index, (camera, label) in enumerate([("a", "x"), ("a", "y"), ("b", "x")])
    for frame in range(8)
]


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.permutations(_table))
def test_row_order_is_irrelevant(tmp_path: Path, rows: list[str]) -> None:
    head = "camera,frame,time,u,v,size,label\n"
    straight = read(tmp_path, head + "\n".join(_table) + "\n")
    shuffled = read(tmp_path, head + "\n".join(rows) + "\n")
    assert same(shuffled, straight), "order of tracks or rows follows the order of the file"


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no\.csv: this observations file does not exist; check the path"):
        read_observations(tmp_path / "no.csv", ["a"])


def test_a_folder_in_its_place_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_observations(tmp_path, ["a"])


def test_not_utf8_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, HEAD.encode() + b"\xff\xfe\x00", None, "cannot be read", "UTF-8")


def test_an_empty_file_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, "", 1, "empty")


def test_a_header_alone_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, HEAD, 1, "no rows")


@pytest.mark.parametrize("column", ["camera", "frame", "time", "u", "v"])
def test_a_missing_column_is_reported(tmp_path: Path, column: str) -> None:
    assert_reported(tmp_path, (HEAD + ROWS).replace(column, "other", 1), 1, f"column {column} is missing")


@pytest.mark.parametrize("sign", [";", "\t", "|"])
def test_another_separator_is_called_one(tmp_path: Path, sign: str) -> None:
    assert_reported(tmp_path, (HEAD + ROWS).replace(",", sign), 1, f"separated by {sign!r}: separate them by commas")


def test_a_column_named_twice_is_reported(tmp_path: Path) -> None:
    """Which of the two is meant nobody knows."""
    assert_reported(tmp_path, "camera,frame,time,u,v,u\na,0,0,1,2,9\n", 1, "u")


@pytest.mark.parametrize(
    ("row", "word"),
    [
        ("a,2,nan,1,2", "time"),
        ("a,2,10.2,inf,2", "u"),
        ("a,2,10.2,1,-inf", "v"),
        ("a,2,10.2,1,NaN", "v"),
        ("a,2,10.2,1,", "v"),
        ("a,2,,1,2", "time"),
        ("a,2,10.2,one,2", "'one'"),
        ("a,2,10.2,1e999,2", "u"),
        ("a,x,10.2,1,2", "frame"),
        ("a,nan,10.2,1,2", "frame"),
        ("a,img_2.png,10.2,1,2", "frame 'img_2.png' is not a finite number; give one, or remove the row"),
        ("a,,10.2,1,2", "frame '' is not a finite number; give one"),
        ("a,2.5,10.2,1,2", "frame"),
        ("a,1e30,10.2,1,2", "frame"),
        ("c,2,10.2,1,2", "'c'"),
        (",2,10.2,1,2", "camera"),
        ("A,2,10.2,1,2", "'A'"),
        ("a,2,10.2,1", "4 columns where the first line has 5"),
        ("a,2,10,2,1,2", "6 columns where the first line has 5"),
        ('a,2,10.2,1,"2', ""),
    ],
)
def test_a_bad_row_is_reported_with_its_line(tmp_path: Path, row: str, word: str) -> None:
    assert_reported(tmp_path, f"{HEAD}a,0,10.0,1.5,2.5\n{row}\n", 3, word)


def test_the_line_is_right_after_empty_lines(tmp_path: Path) -> None:
    assert_reported(tmp_path, f"{HEAD}\n\na,0,0,1,2\n\na,1,1,x,2\n", 6, "'x'")


@pytest.mark.parametrize(("size", "word"), [("-1", "negative"), ("big", "size"), ("inf", "size")])
def test_a_bad_size_is_reported(tmp_path: Path, size: str, word: str) -> None:
    assert_reported(tmp_path, f"camera,frame,time,u,v,size\na,0,0,1,2,3\na,1,1,1,2,{size}\n", 3, word)


@pytest.mark.parametrize(("further", "cells"), [("label", "x"), ("cov_uu,cov_vv", "1,1")])
def test_a_row_cut_before_a_column_is_reported(tmp_path: Path, further: str, cells: str) -> None:
    assert_reported(tmp_path, f"camera,frame,time,u,v,{further}\na,0,0,1,2,{cells}\na,1,1,1,2\n", 3, "columns")


def test_two_rows_of_one_frame_are_reported(tmp_path: Path) -> None:
    rows = "".join(f"a,{i},{i / 10},1,2\n" for i in range(30))
    assert_reported(tmp_path, f"{HEAD}{rows}a,7,0.71,5,5\n", 32, "two rows", "camera a", "frame 7", "label")


def test_two_rows_of_one_frame_are_reported_in_a_short_file_too(tmp_path: Path) -> None:
    rows = "".join(f"a,{i},{i / 10},1,2\n" for i in range(6))
    assert_reported(tmp_path, f"{HEAD}{rows}a,3,0.31,5,5\n", 8, "two rows", "frame 3")


def test_two_rows_of_one_time_are_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, f"{HEAD}a,0,0,1,2\na,1,0.1,1,2\na,2,0.1,5,5\n", 4, "two rows", "camera a")


def test_the_label_is_named_where_rows_repeat(tmp_path: Path) -> None:
    text = "camera,frame,time,u,v,label\na,0,0,1,1,red\na,0,0,2,2,red\n"
    assert_reported(tmp_path, text, 3, "red")


def test_frames_that_are_no_numbering_are_a_warning(tmp_path: Path) -> None:
    """A column of zeros is common where a tool has no frame numbers: the times say it all."""
    rows = "".join(f"a,0,{i / 10},1,2\n" for i in range(30))
    seen = read(tmp_path, HEAD + rows)
    assert len(seen) == 30
    assert "frame" in " ".join(seen.warnings)


def test_people_of_one_label_beside_markers_are_left_out_with_a_warning(tmp_path: Path) -> None:
    head, tag = "camera,frame,time,u,v,label,kind\n", "a,0,0.0,7,8,tag7,marker\n"
    seen = read(tmp_path, f"{head}a,0,0.0,1,2,person,person\n{tag}a,0,0.0,3,4,person,person\n")
    assert seen.labels == ["tag7"]
    assert seen.warnings == ("2 rows of people or vehicles left out: who is who is not known",)
    assert read(tmp_path, f"{head}a,0,0.0,1,2,nose,person\n{tag}a,0,0.0,3,4,ear,person\n").labels == [
        "ear",
        "nose",
        "tag7",
    ]


def test_written_covariances_have_every_digit(tmp_path: Path) -> None:
    head = HEAD.replace("v\n", "v,cov_uu,cov_uv,cov_vv\n")
    seen = read(tmp_path, f"{head}a,0,0.0,1,2,0.11111111111111113,0,0.11111111111111113\n")
    write_observations(tmp_path / "observations.csv", seen)
    again = read_observations(tmp_path / "observations.csv", ["a", "b"])
    assert [track.std for track in again.tracks.values()] == [track.std for track in seen.tracks.values()]


def test_the_newest_rows_are_those_of_each_cameras_last_seconds() -> None:
    """A camera that saw nothing lately, or on another clock, keeps its own last rows."""
    time, unknown = np.array([0.0, 5.0, 9.5, 1000.0, 1008.0]), np.full(5, np.nan)
    rows = gather_tracks(list("aaabb"), list("pqppp"), np.arange(5), time, np.ones((5, 2)), unknown, order=("a", "b"))
    kept = {key: track.time.tolist() for key, track in rows.newest(4.0).tracks.items()}
    assert kept == {("a", "p"): [9.5], ("b", "p"): [1008.0]}
