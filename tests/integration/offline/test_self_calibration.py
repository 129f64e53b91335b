"""Self-calibration of unmeasured lenses, and scale from scale bars; undetermined lenses are refused."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy.cli import run
from edge.lens.models import LENS_MODELS, find_lens_model, horizontal_field_of_view
from edge.lens.solve import intrinsics_from_field_of_view
from hub.calibration.pipeline import calibrate
from hub.calibration.self_calibration import MAX_FOCAL_STD, focal_prior, initial_focal_lengths
from hub.sync.hypothesis import PairFit, PairSolution
from hub.two_view.relative_pose import FundamentalMatrix, relative_pose_between
from protocols.core.errors import InputError
from protocols.session.folder import read_folder
from protocols.session.rig import RigCamera, read_rig
from tests.support.rigs import Path as Curve
from tests.support.rigs import Session, random_lens, random_path, random_poses, simulate
from tests.support.videos import numbered_image, write_video


def test_four_unknown_lenses_are_estimated_with_consistent_stds() -> None:
    full = simulate(70, 4, 30)
    found = calibrate(full.without_lenses().rig, full.observations())
    assert list(found.cameras) == ["cam0", "cam1", "cam2", "cam3"]
    for name, camera in found.cameras.items():
        lens = full.rig.cameras[name].intrinsics
        assert lens is not None
        error = camera.intrinsics.focal / lens.focal - 1.0
        assert 0.0 < camera.focal_std < MAX_FOCAL_STD
        assert abs(error) < 4.0 * camera.focal_std
        assert abs(full.clock_error(name, "cam0", camera.time_map)) < 1e-3
        assert camera.rms_px < 0.8
    given = calibrate(full.rig, full.observations())
    assert all(camera.focal_std == 0.0 for camera in given.cameras.values())
    # The uncertainty of the lenses is included in the position stds.
    assert found.cameras["cam2"].position_std.max() > 3.0 * given.cameras["cam2"].position_std.max()


def test_one_unknown_lens_beside_known_ones_is_estimated_precisely() -> None:
    full = simulate(71, 3, 30)
    found = calibrate(full.without_lenses("cam2").rig, full.observations())
    lens = full.rig.cameras["cam2"].intrinsics
    assert lens is not None
    camera = found.cameras["cam2"]
    assert abs(camera.intrinsics.focal / lens.focal - 1.0) < max(4.0 * camera.focal_std, 0.005)
    known = full.rig.cameras["cam0"].intrinsics
    assert known is not None
    assert found.cameras["cam0"].focal_std == 0.0


def test_a_fisheye_with_a_nominal_field_of_view_is_estimated() -> None:
    full = simulate(72, 4, 30, fisheye=(1, 2))
    cameras = dict(full.rig.cameras)
    for name in ("cam1", "cam2"):
        lens = cameras[name].intrinsics
        assert lens is not None
        matrix = lens.matrix.copy()
        matrix[:2, :2] *= 1.08
        guess = replace(lens, matrix=matrix, distortions=np.zeros(4))
        cameras[name] = replace(cameras[name], intrinsics=guess, focal_std=0.1)
    found = calibrate(replace(full.rig, cameras=cameras), full.observations())
    for name in ("cam1", "cam2"):
        lens, camera = full.rig.cameras[name].intrinsics, found.cameras[name]
        assert lens is not None
        assert camera.intrinsics.fisheye
        assert abs(camera.intrinsics.focal / lens.focal - 1.0) < max(4.0 * camera.focal_std, 0.01)


def test_an_undetermined_lens_is_refused_with_its_timing() -> None:
    full = simulate(73, 3, 5)
    # A small path in the middle of the images does not determine the focal length.
    small = Curve(full.paths["marker"].frequency, full.paths["marker"].phase, full.paths["marker"].amplitude * 0.15)
    full = simulate(73, 3, 15, path=small, noise=0.3)
    session = full.without_lenses("cam1", "cam2")
    status, document = solve(session)
    refused = document["metadata"]["refused"]
    assert status == 3
    assert "focal length only to" in refused["cam2"] or "focal length only to" in refused["cam1"]
    assert all("only its timing is known" in refused[name] for name in ("cam1", "cam2"))


def solve(session: Session) -> tuple[int, dict[str, dict[str, dict[str, str]]]]:
    """Exit status and result.json of the command."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        session.write(place / "s")
        status = run(["calibrate", str(place / "s"), "--out", str(place / "out")])
        return status, json.loads((place / "out" / "result.json").read_text())


def exact_pairs(seed: int, count: int) -> tuple[dict[str, RigCamera], dict[str, float], list[PairSolution]]:
    """Cameras, their true focal lengths, and pairs whose matrices are exact, in coordinates of focal length 800."""
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, count)
    focals = {f"c{i}": float(random_lens(rng).focal) for i in range(count)}
    pairs = []
    for i in range(count):
        for j in range(i):
            s = [focals[f"c{k}"] / 800.0 for k in (j, i)]
            matrix = relative_pose_between(poses[j], poses[i]).matrix
            nominal = np.diag([1 / s[1], 1 / s[1], 1.0]) @ matrix @ np.diag([1 / s[0], 1 / s[0], 1.0])
            fit = PairFit(1.0, 0.0, FundamentalMatrix.of(nominal), *[1.0] * 8)
            pairs.append(PairSolution(f"c{j}", f"c{i}", "ok", fit))
    return {name: RigCamera(name, (1280, 960)) for name in focals}, focals, pairs


def test_exact_matrices_give_exact_focal_lengths() -> None:
    from protocols.session.rig import Rig

    cameras, focals, pairs = exact_pairs(5, 4)
    rig = Rig(cameras)
    start = intrinsics_from_field_of_view((1280, 960), 2 * np.rad2deg(np.arctan(640 / 800)), False)
    found = initial_focal_lengths(
        {n: replace(focal_prior(rig, n), focal_std=10.0) for n in cameras}, dict.fromkeys(cameras, start), pairs
    )
    for name, focal in focals.items():
        assert found[name] == pytest.approx(focal, rel=2e-3)


def test_nominal_intrinsics_of_a_data_sheet_are_marked_as_such(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_video(tmp_path / "cam0.mp4", [numbered_image(i) for i in range(3)], np.arange(3) / 20)
    out = tmp_path / "rig.toml"
    assert run(["intrinsics", str(tmp_path / "cam0.mp4"), "--model", "GoPro Wide", "--out", str(out)]) == 0
    assert "approximate" in capsys.readouterr().out
    table = tomllib.loads(out.read_text())["cam0"]
    assert table["fisheye"] is True
    assert table["focal_std"] == LENS_MODELS["gopro-wide"].std
    lens = read_rig(out).cameras["cam0"].intrinsics
    assert lens is not None
    edge = lens.unproject(np.array([[-0.5, lens.matrix[1, 2]]]))[0]
    assert 2 * np.rad2deg(np.arctan(-edge[0])) == pytest.approx(118.0, abs=1.0)
    assert run(["intrinsics", str(tmp_path / "cam0.mp4"), "--model", "go pro wode", "--out", str(out)]) == 2
    assert "gopro-wide" in capsys.readouterr().err


def test_diagonal_fields_of_view_and_portrait_images_are_supported() -> None:
    brio = find_lens_model("Logitech BRIO")
    assert horizontal_field_of_view(brio, (1920, 1080)) == pytest.approx(82.1, abs=0.1)
    assert horizontal_field_of_view(find_lens_model("oak-d"), (1080, 1920)) == pytest.approx(41.2, abs=0.2)
    with pytest.raises(InputError):
        find_lens_model("camera")


def scale_bar_session(seed: int, length: float) -> Session:
    """Two labels at a constant distance that rotate and move."""
    rng = np.random.default_rng(seed)
    path = random_path(rng)
    session = simulate(seed, 3, 12, labels={"a": range(3), "b": range(3)}, path=path)
    return _with_scale_bar(session, length)


def _with_scale_bar(session: Session, length: float) -> Session:
    """The session with label b at a constant distance from a, in a rotating direction."""
    rng = np.random.default_rng(1)
    pixels = session.pixels.copy()
    for name, camera in session.rig.cameras.items():
        mine = (np.array(session.camera) == name) & (np.array(session.label) == "b")
        true = np.array([session.true_time(name, float(t)) for t in session.time[mine]])
        turn = np.column_stack([np.cos(0.7 * true), np.sin(0.7 * true), 0.5 * np.sin(0.9 * true)])
        turn /= np.linalg.norm(turn, axis=1)[:, None]
        points = session.paths["b"].at(true) + length * turn
        lens = camera.intrinsics
        assert lens is not None
        pixels[mine] = lens.project(session.poses[name].camera_from_world(points)) + rng.normal(0, 0.5, (len(true), 2))
    return replace(session, pixels=pixels)


def distances(found: Mapping[str, np.ndarray]) -> float:
    return float(np.linalg.norm(found["cam0"] - found["cam1"]))


def test_a_scale_bar_of_known_length_gives_the_scale(tmp_path: Path) -> None:
    session = scale_bar_session(80, 0.4)
    session.write(tmp_path / "s", 'units = "cm"\nwand = [["a", "b", 40.0]]')
    assert read_folder(tmp_path / "s")[0].scale_bars == (("a", "b", 40.0),)
    assert run(["calibrate", str(tmp_path / "s"), "--out", str(tmp_path / "out")]) == 0
    found = tomllib.loads((tmp_path / "out" / "calibration.toml").read_text())
    assert found["metadata"]["scale"] == "metric"
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    distance = distances({name: np.array(table["position"]) for name, table in result["cameras"].items()})
    truth = distances({name: pose.position for name, pose in session.poses.items()})
    assert distance == pytest.approx(100.0 * truth, rel=3e-3)


def test_a_scale_bar_that_is_not_rigid_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = simulate(81, 3, 10, labels={"a": range(3), "b": range(3)})
    session.write(tmp_path / "s", 'wand = [["a", "b", 0.4]]')
    assert run(["calibrate", str(tmp_path / "s"), "--out", str(tmp_path / "out")]) == 3
    assert "scale bar (wand) a–b" in capsys.readouterr().err


@pytest.mark.parametrize("wand", ['[["a", "a", 1.0]]', '[["a", "b"]]', '[["a", "b", -1]]', "3"])
def test_an_invalid_scale_bar_is_an_input_error(tmp_path: Path, wand: str) -> None:
    (tmp_path / "rig.toml").write_text(f'[metadata]\nwand = {wand}\n[c]\nname = "c"\nsize = [4, 4]\n')
    with pytest.raises(InputError, match="wand"):
        read_rig(tmp_path / "rig.toml")
