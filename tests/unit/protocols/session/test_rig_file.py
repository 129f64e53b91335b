"""rig.toml: what it may say, and that each mistake is reported with file, line, what and remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protocols.core.errors import InputError
from protocols.geometry import so3
from protocols.session.rig import Rig, misspelt_keys, read_rig
from tests.support import command_line

LENS = "matrix = [[900.0, 0, 640.0], [0, 901.0, 360.0], [0, 0, 1]]\ndistortions = [0.1, 0, 0, 0, 0]\n"
CAM0 = f'[cam0]\nname = "cam0"\nsize = [1280, 720]\nfps = 30\n{LENS}'
CAM1 = f"[cam1]\nsize = [640, 480]\n{LENS}"


def read(tmp_path: Path, text: str | bytes) -> Rig:
    file = tmp_path / "rig.toml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_rig(file)


def assert_reported(tmp_path: Path, text: str | bytes, line: int | None, *words: str) -> None:
    command_line.assert_reported(lambda: read(tmp_path, text), tmp_path / "rig.toml", line, *words)


@pytest.mark.parametrize(
    ("text", "warnings"),
    [
        (f"{CAM0}distortion = [1]\npostion = [0, 0, 1]\n{CAM1}", ["[cam0] distortion", "[cam0] postion"]),
        (f"{CAM0}[metadata]\nunit = 'mm'\ndistance = []\nClock = 'shared'\n", ["[metadata] unit"]),
        (f"{CAM0}notes = 'new tripod'\ntime_offset = 1.0\nreadout_std = 0.1\n[metadata]\nscale = 'metric'\n", []),
    ],
)
def test_a_misspelt_key_is_kept_and_warned_of(tmp_path: Path, text: str, warnings: list[str]) -> None:
    found = misspelt_keys(read(tmp_path, text))
    assert [line.split(" is no key")[0] for line in found][: len(warnings)] == warnings
    assert bool(found) == bool(warnings)


def test_a_full_rig_is_read(tmp_path: Path) -> None:
    rig = read(tmp_path, f'{CAM0}{CAM1}[metadata]\nunits = "cm"\ndistances = [["cam0", "cam1", 3.42]]\n')
    assert list(rig.cameras) == ["cam0", "cam1"]
    camera = rig.cameras["cam0"]
    assert (camera.size, camera.fps) == ((1280, 720), 30.0)
    assert camera.intrinsics is not None
    np.testing.assert_array_equal(camera.intrinsics.matrix[1], [0, 901, 360])
    np.testing.assert_array_equal(camera.intrinsics.distortions, [0.1, 0, 0, 0, 0])
    assert (rig.units, rig.clock, rig.shared_clock) == ("cm", "independent", False)
    assert rig.distances == (("cam0", "cam1", 3.42),)


def test_a_camera_without_lens_is_uncalibrated(tmp_path: Path) -> None:
    camera = read(tmp_path, "[phone]\nsize = [1920, 1080]\n").cameras["phone"]
    assert camera.intrinsics is None
    assert camera.fps == 0.0


def test_fisheye_and_its_four_coefficients(tmp_path: Path) -> None:
    text = CAM0.replace("[0.1, 0, 0, 0, 0]", "[0.1, 0.2, 0.3, 0.4]\nfisheye = true")
    lens = read(tmp_path, text).cameras["cam0"].intrinsics
    assert lens is not None
    assert lens.fisheye
    np.testing.assert_array_equal(lens.distortions, [0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("bad", ['"yes"', '"false"', "1", "[true]"])
def test_fisheye_is_true_or_false_and_nothing_else(tmp_path: Path, bad: str) -> None:
    text = CAM0.replace("[0.1, 0, 0, 0, 0]", f"[0.1, 0.2, 0.3, 0.4]\nfisheye = {bad}")
    assert_reported(tmp_path, text, 7, "fisheye")


def test_zeros_of_a_richer_model_are_no_distortion(tmp_path: Path) -> None:
    lens = read(tmp_path, CAM0.replace("[0.1, 0, 0, 0, 0]", f"{[0.1, *[0] * 13]}")).cameras["cam0"].intrinsics
    assert lens is not None
    np.testing.assert_array_equal(lens.distortions, [0.1, 0, 0, 0, 0])


def test_distortions_may_be_absent(tmp_path: Path) -> None:
    lens = read(tmp_path, CAM0.replace("distortions = [0.1, 0, 0, 0, 0]\n", "")).cameras["cam0"].intrinsics
    assert lens is not None
    np.testing.assert_array_equal(lens.distortions, np.zeros(5))


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("[0.1, 0, 0, 0, 0]", "[1e10, 0, 0, 0, 0]", 6),
        ("[900.0,", "[1e9,", 5),
        ("[900.0,", "[0.5,", 5),
        ("fps = 30", "fps = 1e6", 4),
        ("[1280, 720]", "[1280, 1e6]", 3),
    ],
)
def test_what_no_camera_is_like_is_reported(tmp_path: Path, old: str, new: str, line: int) -> None:
    assert_reported(tmp_path, CAM0.replace(old, new), line)


def test_translation_and_rotation_give_the_position(tmp_path: Path) -> None:
    text = f"{CAM0}rotation = [0.1, 0.2, 0.3]\ntranslation = [1.0, 2.0, 3.0]\n"
    camera = read(tmp_path, text).cameras["cam0"]
    r = so3.exp(np.array([0.1, 0.2, 0.3]))
    assert camera.position is not None
    np.testing.assert_allclose(r @ camera.position, [-1, -2, -3], atol=1e-12)


def test_position_that_agrees_with_translation_is_welcome(tmp_path: Path) -> None:
    text = f"{CAM0}rotation = [0, 0, 0]\ntranslation = [1.0, 2.0, 3.0]\nposition = [-1.0, -2.0, -3.0]\n"
    np.testing.assert_array_equal(read(tmp_path, text).cameras["cam0"].position, [-1, -2, -3])


def test_position_that_contradicts_translation_is_reported(tmp_path: Path) -> None:
    text = f"{CAM0}rotation = [0, 0, 0]\ntranslation = [1.0, 2.0, 3.0]\nposition = [1.0, 2.0, 3.0]\n"
    assert_reported(tmp_path, text, 9, "cam0", "position", "contradicts translation", "remove one")


def test_a_camera_at_the_origin_may_say_so_twice(tmp_path: Path) -> None:
    text = f"{CAM0}rotation = [0.1, 0.2, 0]\ntranslation = [0.0, 0.0, 0.0]\nposition = [0.0, 0.0, 0.0]\n"
    position = read(tmp_path, text).cameras["cam0"].position
    assert position is not None
    np.testing.assert_allclose(position, 0, atol=1e-12)


@pytest.mark.parametrize("position", ["[-1.002, -2.0, -3.0]", "[-1.0, -2.0, -3.5]"])
def test_a_contradiction_of_centimetres_in_metres_is_not_rounding(tmp_path: Path, position: str) -> None:
    """3.7 m off with 1 mm allowed; 2 mm at 3.7 m is rounding, half a metre is not."""
    text = f"{CAM0}rotation = [0, 0, 0]\ntranslation = [1.0, 2.0, 3.0]\nposition = {position}\n"
    if "3.5" in position:
        assert_reported(tmp_path, text, 9, "contradicts")
    else:
        read(tmp_path, text)


def test_stds_may_be_one_number_or_three(tmp_path: Path) -> None:
    text = f"{CAM0}position = [0, 0, 0]\nposition_std = 0.01\nrotation = [0, 0, 0]\nrotation_std = [0.1, 0.2, 0.3]\n"
    camera = read(tmp_path, text).cameras["cam0"]
    np.testing.assert_array_equal(camera.position_std, [0.01] * 3)
    np.testing.assert_array_equal(camera.rotation_std, [0.1, 0.2, 0.3])


def test_a_std_of_zero_is_exactly_known(tmp_path: Path) -> None:
    camera = read(tmp_path, f"{CAM0}position = [0, 0, 0]\nposition_std = 0\n").cameras["cam0"]
    np.testing.assert_array_equal(camera.position_std, [0.0] * 3)


def test_up_is_a_unit_vector_or_a_camera(tmp_path: Path) -> None:
    vector = read(tmp_path, f"{CAM0}[metadata]\nup = [0, 0, 2.0]\n").up
    np.testing.assert_array_equal(vector, [0, 0, 1])
    assert read(tmp_path, f'{CAM0}[metadata]\nup = "cam0"\n').up == "cam0"


def test_a_camera_may_know_where_up_is(tmp_path: Path) -> None:
    found = read(tmp_path, f"{CAM0}up = [0, -2.0, 0]\n")
    assert found.up == "cam0"
    np.testing.assert_array_equal(found.up_in_camera("cam0"), [0, -1, 0])
    levelled = read(tmp_path, f'{CAM0}[metadata]\nup = "cam0"\n')
    np.testing.assert_array_equal(levelled.up_in_camera("cam0"), [0, -1, 0])
    with pytest.raises(InputError, match="up has no direction"):
        read(tmp_path, f"{CAM0}up = [0, 0, 0]\n")
    other = CAM0.replace("cam0", "cam1")
    with pytest.raises(InputError, match="several cameras give up"):
        read(tmp_path, f"{CAM0}up = [0, -1, 0]\n{other}up = [0, -1, 0]\n")
    both = f'{CAM0}up = [0, -1, 0]\n{other}up = [1, 0, 0]\n[metadata]\nup = "cam1"\n'
    np.testing.assert_array_equal(read(tmp_path, both).up_in_camera("cam1"), [1, 0, 0])


def test_shared_clock(tmp_path: Path) -> None:
    assert read(tmp_path, f'{CAM0}[metadata]\nclock = "shared"\n').shared_clock


def test_unknown_keys_are_kept_in_the_table(tmp_path: Path) -> None:
    camera = read(tmp_path, f'{CAM0}serial = "A7"\n').cameras["cam0"]
    assert camera.table["serial"] == "A7"


def test_crlf_is_fine(tmp_path: Path) -> None:
    assert list(read(tmp_path, (CAM0 + CAM1).replace("\n", "\r\n")).cameras) == ["cam0", "cam1"]


def test_a_byte_order_mark_is_fine(tmp_path: Path) -> None:
    """Windows' editors write one."""
    assert list(read(tmp_path, b"\xef\xbb\xbf" + CAM0.encode()).cameras) == ["cam0"]


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: this rig file does not exist; check the path"):
        read_rig(tmp_path / "none.toml")


def test_a_folder_in_its_place_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_rig(tmp_path)


def test_not_utf8_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, b'[cam0]\nname = "\xff\xfe"\n', None, "cannot be read")


@pytest.mark.parametrize("text", ["", "# nothing\n", '[metadata]\nunits = "m"\n'])
def test_a_rig_without_cameras_is_reported(tmp_path: Path, text: str) -> None:
    assert_reported(tmp_path, text, None, "no camera")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[cam0\nsize = [1, 2]\n", 1),
        (CAM0 + "size = [1, 2]\n", 7),  # a key twice
        (CAM0 + "[cam1]\nsize = [640, \n", None),
    ],
)
def test_what_is_no_toml_is_reported(tmp_path: Path, text: str, line: int | None) -> None:
    assert_reported(tmp_path, text, line, "not valid TOML")


@pytest.mark.parametrize(
    ("old", "new", "line", "word"),
    [
        ("size = [1280, 720]", "size = [1280]", 3, "size"),
        ("size = [1280, 720]", 'size = ["a", "b"]', 3, "size"),
        ("size = [1280, 720]", "size = [0, 720]", 3, "size"),
        ("size = [1280, 720]", "size = [1280.5, 720]", 3, "size"),
        ("size = [1280, 720]", "size = [nan, 720]", 3, "size"),
        ("size = [1280, 720]\n", "", 1, "size"),
        ("fps = 30", "fps = -1", 4, "fps"),
        ("fps = 30", "fps = nan", 4, "fps"),
        ("fps = 30", 'fps = "30"', 4, "fps"),
        ("fps = 30", "fps = true", 4, "fps"),
        ("900.0", "-900.0", 5, "matrix"),
        ("900.0", "inf", 5, "matrix"),
        ("900.0", "nan", 5, "matrix"),
        ("[0, 0, 1]]", "[0, 0, 2]]", 5, "matrix"),
        (", [0, 0, 1]]", "]", 5, "matrix"),
        ("[0.1, 0, 0, 0, 0]", "[0.1]", 6, "distortions"),
        ("[0.1, 0, 0, 0, 0]", '"none"', 6, "distortions"),
        ("[0.1, 0, 0, 0, 0]", "[nan, 0, 0, 0, 0]", 6, "distortions"),
        ("[0.1, 0, 0, 0, 0]", "[0.1, 0, 0, 0, 0, 0, 0, 0.2]", 6, "first of these alone are another lens"),
        ("fps = 30", "rotation = [90.0, 0, 0]", 4, "radians"),
        ('name = "cam0"', 'name = "other"', 2, "name"),
    ],
)
def test_a_wrong_value_is_reported_with_its_line(tmp_path: Path, old: str, new: str, line: int, word: str) -> None:
    assert_reported(tmp_path, CAM0.replace(old, new), line, "cam0", word)


@pytest.mark.parametrize(
    "extra",
    [
        "position = [1, 2]",
        "position = [nan, 0, 0]",
        "position = 3",
        "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
        "translation = [0, 0, 0]",
        "position_std = -0.1",
        'position_std = "good"',
        "rotation_std = [0.1, 0.1]",
        "body_from_camera = [1, 0, 0]",
        "body_from_camera = [[2, 0, 0], [0, 1, 0], [0, 0, 1]]",
    ],
)
def test_a_wrong_reference_is_reported_with_its_line(tmp_path: Path, extra: str) -> None:
    assert_reported(tmp_path, f"{CAM0}{extra}\n", 7, extra.split(" =")[0])


@pytest.mark.parametrize(
    ("entry", "word"),
    [
        ('units = "inch"', "units"),
        ("units = 1", "units"),
        ('units = ["m"]', "units"),
        ('clock = "common"', "clock"),
        ('clock = ["shared"]', "clock"),
        ('distances = [["cam0", "cam9", 1.0]]', "cam9"),
        ('distances = [["cam0", "cam1"]]', "distances"),
        ('distances = [["cam0", "cam1", -1.0]]', "distance"),
        ('distances = [["cam0", "cam1", nan]]', "distance"),
        ('distances = [["cam0", "cam0", 1.0]]', "distance"),
        ('distances = [["cam0", "cam1", true]]', "distance"),
        ('distances = [[["cam0"], "cam1", 1.0]]', "distance"),
        ("distances = 3.42", "distance"),
        ('up = "cam9"', "cam9"),
        ("up = [0, 0, 0]", "up"),
        ("up = [0, 1]", "up"),
        ("up = [0, nan, 1]", "up"),
        ("up = 1", "up"),
    ],
)
def test_wrong_metadata_is_reported_with_its_line(tmp_path: Path, entry: str, word: str) -> None:
    assert_reported(tmp_path, f"[metadata]\n{entry}\n{CAM0}{CAM1}", 2, word)


def test_metadata_that_is_no_table_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, f"metadata = 3\n{CAM0}", None, "metadata")


def test_a_value_outside_a_table_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, f'units = "m"\n{CAM0}', None, "units")


def test_an_array_of_tables_is_reported(tmp_path: Path) -> None:
    assert_reported(tmp_path, CAM0.replace("[cam0]", "[[cam0]]"), None, "cam0")


def test_a_name_with_a_full_stop_needs_quotes(tmp_path: Path) -> None:
    assert_reported(tmp_path, "[cam.0]\nsize = [1280, 720]\n", 1, 'needs quotes: ["cam.0"]')


def test_a_quoted_name_keeps_its_line(tmp_path: Path) -> None:
    text = '["cam 0"]\nsize = [1280]\n'
    assert_reported(tmp_path, text, 2, "cam 0", "size")


def test_a_list_over_many_lines_does_not_hide_the_line_of_a_later_key(tmp_path: Path) -> None:
    text = "[cam0]\nmatrix = [\n  [900.0, 0, 640.0],\n  [0, 900.0, 360.0],\n  [0, 0, 1],\n]\nsize = [1280]\n"
    assert_reported(tmp_path, text, 7, "size")
