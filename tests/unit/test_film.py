"""Films: every frame with its own time, upright, damage counted; and pictures in a folder."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.devices.playback import video_reader as film_module
from edge.devices.playback.video_reader import Film
from protocols.core.errors import InputError
from tests.films import number_in, numbered, write_film

TIMES = np.cumsum(np.r_[0.0, np.random.default_rng(5).uniform(0.01, 0.08, 39)])


@pytest.mark.parametrize(("pyav", "within"), [(True, 1e-5), (False, 1.1e-3)])
def test_a_variable_frame_rate_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pyav: bool, within: float
) -> None:
    write_film(tmp_path / "a.mp4", [numbered(i) for i in range(40)], TIMES)
    monkeypatch.setattr(film_module, "has_pyav", lambda: pyav)
    shots = list(Film(tmp_path / "a.mp4"))
    assert [shot.frame for shot in shots] == list(range(40))
    assert [number_in(shot.image()) for shot in shots] == list(range(40))
    np.testing.assert_allclose([shot.time for shot in shots], TIMES, atol=within)


def test_a_damaged_frame_is_skipped_and_counted_and_the_others_keep_their_times(tmp_path: Path) -> None:
    file = tmp_path / "a.mkv"
    write_film(file, [numbered(i) for i in range(40)], TIMES, codec="mjpeg")
    bytes_ = bytearray(file.read_bytes())
    starts = [i for i in range(len(bytes_) - 2) if bytes_[i : i + 3] == b"\xff\xd8\xff"]
    bytes_[starts[17] : starts[18] - 12] = bytes(starts[18] - 12 - starts[17])
    file.write_bytes(bytes_)
    film = Film(file)
    shots = list(film)
    assert film.corrupt == 1
    left = [i for i in range(40) if i != 17]
    assert [number_in(shot.image()) for shot in shots] == left
    np.testing.assert_allclose([shot.time for shot in shots], TIMES[left], atol=1.1e-3)


def test_a_file_that_was_cut_off_gives_what_is_in_it(tmp_path: Path) -> None:
    file = tmp_path / "a.ts"
    write_film(file, [numbered(i) for i in range(40)], TIMES)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    shots = list(Film(file))
    assert 10 < len(shots) < 40
    assert [number_in(shot.image()) for shot in shots[:10]] == list(range(10))


def test_portrait_films_stand_upright_as_opencv_shows_them(tmp_path: Path) -> None:
    """A phone held upright stores lying pictures and a note in the track's header."""
    write_film(tmp_path / "a.mp4", [numbered(5)] * 3, [0.0, 0.1, 0.2])
    content = (tmp_path / "a.mp4").read_bytes()
    lying = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    turned = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    at = content.index(lying, content.index(b"tkhd"))
    (tmp_path / "b.mp4").write_bytes(content[:at] + turned + content[at + len(turned) :])
    film = Film(tmp_path / "b.mp4")
    assert film.info.size == (32, 160)
    good, expected = cv2.VideoCapture(str(tmp_path / "b.mp4")).read()
    assert good
    picture = next(iter(film)).image()
    assert picture.shape == (160, 32, 3)
    assert np.abs(picture.astype(int) - expected).mean() < 1.0


def test_a_bad_picture_of_a_folder_is_skipped_but_takes_its_time(tmp_path: Path) -> None:
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{i}.png"), numbered(i))
    (tmp_path / "2.png").write_bytes(b"no picture")
    film = Film(tmp_path, fps=10.0)
    assert [(shot.frame, round(shot.time, 6), number_in(shot.image())) for shot in film] == [
        (0, 0.0, 0),
        (1, 0.1, 1),
        (2, 0.3, 3),
        (3, 0.4, 4),
    ]
    assert film.corrupt == 1


@pytest.mark.parametrize("name", ["nothing.mp4", "text.mp4", "empty"])
def test_what_is_no_film_is_told_with_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "text.mp4").write_text("not a video")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=name):
        Film(tmp_path / name)
