"""Pixels that fill a part of the stated picture only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protocols.core.errors import InputError
from protocols.session.folder import read_folder


def session(folder: Path, scale: float) -> Path:
    """Two cameras of 640x480 whose target moves through all of it, with pixels times ``scale``."""
    tables = (f'[{name}]\nname = "{name}"\nsize = [640, 480]\nfps = 30.0\n' for name in "ab")
    (folder / "rig.toml").write_text("\n".join(tables), encoding="utf-8")
    lines = ["camera,frame,time,u,v"]
    for name in "ab":
        for frame, (u, v) in enumerate(np.random.default_rng(5).uniform(0.0, [640.0, 480.0], (200, 2))):
            lines.append(f"{name},{frame},{frame / 30},{scale * u},{scale * v}")
    (folder / "observations.csv").write_text("\n".join(lines), encoding="utf-8")
    return folder


def test_pixels_of_a_smaller_picture_are_named(tmp_path: Path) -> None:
    """Half of them calibrated cameras a third of a baseline off."""
    _, observations = read_folder(session(tmp_path, 0.5))
    (warning,) = observations.warnings
    assert warning.startswith("every camera's rows lie in the upper left of its picture, within 0.")


def test_fractions_of_a_picture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a: all of its 200 rows lie within one pixel .* they are fractions of it"):
        read_folder(session(tmp_path, 1.0 / 640.0))


def test_pixels_of_the_whole_picture_are_no_warning(tmp_path: Path) -> None:
    assert read_folder(session(tmp_path, 1.0))[1].warnings == ()
