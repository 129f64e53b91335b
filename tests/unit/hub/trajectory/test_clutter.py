"""Rows at a fixed pixel that is no target are found; a target that rests, returns or goes round is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hub.bundle.preprocessing import prepare, static_clutter
from protocols.geometry.types import Floats
from protocols.session.observations import Observations
from tests.support.rigs import random_path, simulate

SIZE, LAMP = np.array([1280.0, 720.0]), np.array([384.0, 432.0])


def moving(rng: np.random.Generator, fps: float = 30.0, seconds: float = 60.0) -> Floats:
    """(n, 2) [px] of a target that moves by some hundred pixels a second."""
    path = random_path(rng).at(np.arange(0, seconds, 1 / fps))[:, :2]
    return 0.5 * SIZE + 250.0 * path + rng.normal(0, 0.5, path.shape)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.03, 0.3])
def test_a_lamp_among_rows_of_a_target_is_found(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    pixels = moving(rng)
    lit = rng.random(len(pixels)) < share
    pixels[lit] = np.rint(LAMP + rng.normal(0, 1.0, (lit.sum(), 2)))
    spot = static_clutter(pixels)
    assert spot is not None
    assert np.hypot(*(spot - LAMP)) < 1.5
    assert static_clutter(pixels[~lit]) is None


@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_a_target_is_no_clutter(fps: float) -> None:
    rng = np.random.default_rng(4)
    time = np.arange(0, 120.0, 1 / fps)
    angle = np.cumsum(rng.uniform(0.3, 3.0, 121).repeat(int(fps))[: len(time)]) / fps  # another speed every second
    around = 0.5 * SIZE + np.column_stack([300.0 * np.cos(angle), 150.0 * np.sin(2.0 * angle)])
    exactly = around[np.arange(len(time)) % int(7 * fps)]  # the same pixels every 7 s
    hovering = moving(rng, fps, 120.0)[np.maximum.accumulate(np.arange(len(time)) * (np.sin(time) > 0.0))]
    for target in (around, exactly, hovering):
        for false in (0.0, 0.2):
            pixels = np.rint(target + rng.normal(0, 0.5, target.shape))
            wrong = rng.random(len(pixels)) < false
            pixels[wrong] = rng.uniform(0, SIZE, (wrong.sum(), 2))
            for some in (slice(None), rng.random(len(pixels)) > 0.4):  # and out of view now and then
                assert static_clutter(pixels[some]) is None


def test_a_session_leaves_a_lamp_out_while_the_target_is_out_of_view_and_says_so() -> None:
    session, rng = simulate(5, 2), np.random.default_rng(5)
    tracks = dict(session.observations().tracks)
    key = next(iter(tracks))
    track = tracks[key]
    pixels, absent = track.pixels.copy(), (track.time - track.time[0]) % 10.0 > 7.0
    lit = (rng.random(len(pixels)) < 0.1) | absent
    pixels[lit] = LAMP + rng.normal(0, 0.5, (lit.sum(), 2))
    tracks[key] = replace(track, pixels=pixels)
    found = prepare(session.rig, Observations(tracks))
    assert not any(
        lit[np.isin(track.time, part.stamps + found.time_origins[key[0]])].any() for part in found.rows[key[0]]
    )
    (warning,) = found.warnings
    assert warning.startswith("cam0: ")
    assert f"({lit.mean():.1%}) are at pixel (384, 432)" in warning


@pytest.mark.parametrize(("kind", "share"), [("repeated", 0.3), ("whole pixels", 0.0), ("at rest", 0.0)])
def test_rows_that_repeat_the_one_before_are_left_out_and_others_are_not(kind: str, share: float) -> None:
    session, rng = simulate(5, 2), np.random.default_rng(5)
    tracks = dict(session.observations().tracks)
    key = next(iter(tracks))
    track = tracks[key]
    late = rng.random(len(track)) < 0.3 if kind != "at rest" else np.arange(len(track)) % 200 > 100
    late[0] = False
    pixels = track.pixels[np.maximum.accumulate(np.arange(len(track)) * ~late)]
    tracks[key] = replace(track, pixels=np.rint(pixels) if kind == "whole pixels" else pixels)
    prepared = prepare(session.rig, Observations(tracks))
    left_out = len(track) - len(prepared.rows[key[0]][0].time)
    assert left_out == (late.sum() if share else 0)
    said = f"{key[0]}: {late.mean():.0%} of its frames repeat the one before and were left out"
    assert prepared.warnings == ((said,) if share else ())
