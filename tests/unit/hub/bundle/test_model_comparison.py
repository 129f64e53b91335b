"""Rolling-shutter readouts are estimated where they are observable, and fixed where they are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hub.calibration.pipeline import calibrate
from protocols.core.errors import InputError
from protocols.session.calibration import Calibration, read_calibration
from protocols.session.rig import RigCamera, read_rig
from tests.support import rigs
from tests.support.written import write_calibration

SEED = 7310
READOUTS = (0.025, 0.0, 0.03, 0.015)


def rolling(readouts: tuple[float, ...], seed: int = SEED) -> rigs.Session:
    """A session with rolling shutters: lower image rows are exposed later."""
    session = rigs.simulate(seed, len(readouts), 20.0, drops=0.0, late=3.0)
    rng = np.random.default_rng(seed)
    pixels = session.pixels.copy()
    names = np.array(session.camera)
    for (name, camera), readout in zip(session.rig.cameras.items(), readouts, strict=True):
        mine, lens = names == name, camera.intrinsics
        assert lens is not None
        label = session.label[int(np.flatnonzero(mine)[0])]
        row = np.full(int(mine.sum()), 0.5 * (lens.height - 1))
        for _ in range(6):
            shown = session.time[mine] + readout * (row / (lens.height - 1) - 0.5)
            seen = lens.project(session.poses[name].camera_from_world(session.truth_at(label, name, shown)))
            row = seen[:, 1]
        pixels[mine] = seen + rng.normal(0, 0.5, seen.shape)
    return replace(session, pixels=pixels)


def worst_clock(session: rigs.Session, found: Calibration) -> float:
    names = list(found.cameras)
    return max(abs(session.clock_error(name, names[0], found.cameras[name].time_map)) for name in names[1:])


def with_readouts(session: rigs.Session, readouts: tuple[float, ...]) -> rigs.Session:
    cameras: dict[str, RigCamera] = {
        name: replace(camera, readout=readout)
        for (name, camera), readout in zip(session.rig.cameras.items(), readouts, strict=True)
    }
    return replace(session, rig=replace(session.rig, cameras=cameras))


def test_readouts_are_estimated_and_clocks_refer_to_the_middle_row(tmp_path: Path) -> None:
    session = rolling(READOUTS)
    found = calibrate(session.rig, session.observations())
    for camera, readout in zip(found.cameras.values(), READOUTS, strict=True):
        assert (0.0 < camera.readout_std < 4e-3) == (readout > 0.0)
        assert abs(camera.readout - readout) <= 4 * camera.readout_std
    assert worst_clock(session, found) < 0.8e-3
    assert np.degrees(session.turn_error({name: one.pose for name, one in found.cameras.items()})) < 0.1
    assert sum("rolling-shutter" in warning for warning in found.warnings) == 3

    file = tmp_path / "calibration.toml"
    write_calibration(file, found, session.rig)
    rig, again = read_calibration(file)
    assert [camera.readout for camera in again.values()] == [camera.readout for camera in found.cameras.values()]
    assert [camera.readout or 0.0 for camera in rig.cameras.values()] == [camera.readout for camera in again.values()]


def test_a_global_shutter_is_not_given_a_readout() -> None:
    session = rolling((0.0, 0.0, 0.0, 0.0))
    found = calibrate(session.rig, session.observations())
    assert [(camera.readout, camera.readout_std) for camera in found.cameras.values()] == [(0.0, 0.0)] * 4


def test_given_readouts_are_fixed() -> None:
    session = with_readouts(rolling(READOUTS), READOUTS)
    found = calibrate(session.rig, session.observations())
    assert [(camera.readout, camera.readout_std) for camera in found.cameras.values()] == [(r, 0.0) for r in READOUTS]
    assert worst_clock(session, found) < 0.8e-3


@pytest.mark.parametrize("value", ["0.2", "-0.07", "nan", "true", '"fast"'])
def test_a_readout_that_no_camera_has_is_refused(tmp_path: Path, value: str) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(f'[cam0]\nname = "cam0"\nsize = [640, 480]\nreadout = {value}\n', encoding="utf-8")
    with pytest.raises(InputError, match="readout"):
        read_rig(file)
