"""Every allowed camera name survives session folder, log, bus key and every export format; the key is injective."""

from __future__ import annotations

import re
import tempfile
import unicodedata
from pathlib import Path
from typing import Any

import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.cli import run
from deploy.offline.exchange.session_log import rig_tables_of_log, session_to_log
from protocols.core.names import MAX_SEGMENT, is_name, key_segment, name_of_segment
from protocols.log.read.session import session_from_log
from protocols.session.calibration import read_calibration
from protocols.session.folder import read_folder, write_observations, write_rig
from protocols.topics import OBSERVATION
from protocols.validation.codec import parse_key

characters = st.characters(categories=("L", "M", "Nd")) | st.sampled_from("-_. abcXYZ019äß")
names = st.text(characters, min_size=1, max_size=63).map(lambda t: unicodedata.normalize("NFC", t)).filter(is_name)
identifiers = st.from_regex(r"\A[a-z0-9][a-z0-9_-]{0,62}\Z").filter(is_name)
anything = st.text(max_size=12) | st.text(st.sampled_from("%0123456789abcdefABCDEF-_.c "), max_size=12)

FORMATS = {
    "aniposelib": "a.toml",
    "caliscope": "camera_array.toml",
    "pose2sim": "Calib.toml",
    "freemocap": "camera_calibration.toml",
    "opencv": "yml",
    "kalibr": "camchain.yaml",
    "colmap": "model",
}


@given(names)
def test_a_key_segment_has_only_safe_characters_and_gives_the_name_back(name: str) -> None:
    segment = key_segment(name)
    assert re.fullmatch(r"[A-Za-z0-9_%-]+", segment)
    assert len(segment) <= MAX_SEGMENT
    assert name_of_segment(segment) == name


@given(names | identifiers, names | identifiers)
def test_two_names_never_share_a_key_segment(one: str, other: str) -> None:
    assert (key_segment(one) == key_segment(other)) == (one == other)


@given(identifiers)
def test_a_lower_case_identifier_is_its_own_key_segment(name: str) -> None:
    assert key_segment(name) == name


@given(anything)
def test_a_segment_that_gives_a_name_is_the_segment_of_that_name(segment: str) -> None:
    name = name_of_segment(segment)
    assert name is None or key_segment(name) == segment


@given(names)
def test_a_name_is_one_component_of_a_path(name: str) -> None:
    assert Path(f"{name}.yml").stem == name
    assert (Path("out") / f"{name}.yml").parent == Path("out")
    assert len(f"{name}.part.mp4".encode()) <= 255


def tables(pair: list[str]) -> dict[str, Any]:
    """Two calibrated cameras."""
    return {
        name: {
            "name": name,
            "size": [640, 480],
            "matrix": [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]],
            "distortions": [0.0] * 5,
            "rotation": [0.0, 0.1 * number, 0.0],
            "translation": [float(number), 0.0, 0.0],
        }
        for number, name in enumerate(pair)
    } | {"metadata": {"units": "m", "reference": pair[1]}}


@settings(max_examples=15, deadline=None)
@given(st.lists(names, min_size=2, max_size=2, unique=True))
def test_allowed_names_pass_session_log_bus_key_and_every_export(pair: list[str]) -> None:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_rig(folder / "rig.toml", tables(pair))
        rows = "".join(f"{name},{i},{i / 10},{i},{i}\n" for name in pair for i in range(5))
        (folder / "observations.csv").write_text("camera,frame,time,u,v\n" + rows, encoding="utf-8")
        rig, observations = read_folder(folder)
        session_to_log(rig, observations, folder / "log.mcap")
        logged, again, _ = session_from_log(folder / "log.mcap")
        assert set(logged.cameras) == set(again.cameras) == set(pair)
        write_rig(folder / "again" / "rig.toml", rig_tables_of_log(logged))
        write_observations(folder / "again" / "observations.csv", again)
        assert set(read_folder(folder / "again")[1].cameras) == set(pair)
        for name in pair:
            address = parse_key(OBSERVATION.key_for("local", name))
            assert address is not None
            assert address.agent == name
        calibration = folder / "calibration.toml"
        calibration.write_text(tomli_w.dumps(tables(pair)), encoding="utf-8")
        for project, file in FORMATS.items():
            out = folder / project / file
            out.parent.mkdir()
            assert run(["export", str(calibration), "--to", project, "--out", str(out)]) == 0
            back = folder / project / "back.toml"
            assert run(["import", str(out), "--format", project, "--out", str(back), "--units", "m"]) == 0
            assert set(read_calibration(back)[1]) == set(pair)
