"""result.json says what calibration.toml says, and more, in strict JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from protocols.core.errors import InputError
from protocols.session.calibration import calibration_tables
from protocols.session.result import refusal_document, result_document, result_text
from tests.support.solved_session import solved_session
from tests.support.written import write_result


def test_every_figure_of_calibration_toml_is_in_it_unchanged() -> None:
    calibration, rig, _ = solved_session()
    document = json.loads(result_text(result_document(calibration, rig)))
    for name, table in calibration_tables(calibration, rig).items():
        table = document["metadata"] if name == "metadata" else document["cameras"][name]
        for key, value in table.items():
            assert table[key] == json.loads(json.dumps(value)), (name, key)


def test_floats_read_back_bit_for_bit() -> None:
    calibration, rig, _ = solved_session()
    camera = calibration.cameras["cam1"]
    table = json.loads(result_text(result_document(calibration, rig)))["cameras"]["cam1"]
    assert table["time_offset"] == camera.time_map.time_offset
    assert table["position"] == camera.pose.position.tolist()
    assert table["rotation"] == camera.pose.rodrigues.tolist()


def test_pairs_come_with_a_row_major_fundamental_of_norm_one() -> None:
    calibration, rig, _ = solved_session()
    pairs = json.loads(result_text(result_document(calibration, rig)))["pairs"]
    assert [pair["cameras"] for pair in pairs] == [list(pair.cameras) for pair in calibration.pairs]
    first = calibration.pairs[0].fundamental
    assert first is not None
    assert pairs[0]["fundamental"] == [first[i, j] for i in range(3) for j in range(3)]
    assert np.linalg.norm(pairs[0]["fundamental"]) == pytest.approx(1.0)
    assert pairs[-1]["status"] != "ok"
    assert pairs[-1]["lag_s"] is None


def test_what_is_not_finite_is_null_and_the_json_is_strict() -> None:
    calibration, rig, _ = solved_session(time_offset_std=float("inf"))

    def no_constant(name: str) -> None:
        raise AssertionError(name)

    document = json.loads(result_text(result_document(calibration, rig)), parse_constant=no_constant)
    assert document["cameras"]["cam1"]["time_offset_std"] is None


def test_the_trajectory_is_summed_up() -> None:
    calibration, rig, _ = solved_session()
    trajectory = result_document(calibration, rig)["trajectory"]
    path = calibration.trajectories[0]
    assert trajectory["file"] == "trajectory.csv"
    assert trajectory["labels"][0]["rows"] == len(path.time)
    assert trajectory["labels"][0]["last_time"] == path.time[-1]


def test_the_same_input_gives_the_same_bytes() -> None:
    texts = []
    for _ in range(2):
        calibration, rig, _ = solved_session()
        texts.append(result_text(result_document(calibration, rig, command="syncline calibrate s --out o")))
    assert texts[0] == texts[1]


def test_a_refusal_has_the_same_keys_and_says_why() -> None:
    calibration, rig, _ = solved_session()
    solved = result_document(calibration, rig)
    refused = refusal_document("no pair could be tied together", {"cam0": "hardly moves"}, rig)
    assert list(refused) == list(solved)
    assert refused["status"] == "refused"
    assert refused["reason"] == "no pair could be tied together"
    assert refused["metadata"]["refused"] == {"cam0": "hardly moves"}
    assert refused["cameras"] == {}


def test_dates_in_the_rig_file_do_not_stop_it(tmp_path: Path) -> None:
    import datetime

    calibration, rig, _ = solved_session()
    rig.metadata["recorded"] = datetime.date(2024, 5, 17)
    write_result(tmp_path / "result.json", result_document(calibration, rig))
    assert json.loads((tmp_path / "result.json").read_text())["metadata"]["recorded"] == "2024-05-17"


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    calibration, rig, _ = solved_session()
    with pytest.raises(InputError, match="cannot be written"):
        write_result(tmp_path / "file" / "result.json", result_document(calibration, rig))
