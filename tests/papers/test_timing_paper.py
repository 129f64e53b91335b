"""The asynchronous calibration paper is reproduced: its equations, sweeps and figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hub.baselines.alternating_lag import corresponding_points, estimate_alternately, overall_lag, search_start
from protocols.core.errors import Refused
from protocols.geometry.camera import Intrinsics
from protocols.session.observations import Observations, Track
from protocols.session.rig import Rig, RigCamera
from tests.papers import timing_figures
from tests.papers.timing_default import default_method
from tests.papers.timing_paper import DEFAULT_DATA, METHODS, real_section, uniform_rotation_summary
from tests.papers.timing_real import (
    NEAR,
    SHIFT,
    Recording,
    default_shift,
    delay,
    most_common,
    read_recording,
    run,
)
from tests.papers.timing_rig import (
    CAMERA_1,
    CAMERA_2,
    FOCAL,
    PERIOD,
    PRINTED_F,
    TRAJECTORIES,
    LagResult,
    bin_bias,
    film,
    first_failure,
    paper_method,
    printed_fundamental,
    project,
    sweep,
    trajectory_1,
    trajectory_a,
    trajectory_b,
    trajectory_c,
)


@pytest.fixture(scope="module")
def swept() -> list[LagResult]:
    """Figures 11 to 13: 0.01 to 0.39 s by the paper's step of 0.01 s, for a coarser one misses the lags that fail."""
    return sweep()


def test_equation_23_is_reproduced() -> None:
    assert np.abs(printed_fundamental() - PRINTED_F).max() < 1e-5


def test_the_sweep_fails_where_the_paper_fails_and_is_exact_below(swept: list[LagResult]) -> None:
    limit = first_failure(swept)
    assert 0.28 <= limit <= 0.38
    below = [result for result in swept if result.tau < limit]
    assert np.mean([abs(result.tau_error) for result in below]) <= 1e-4
    assert np.mean([result.f_error for result in below]) <= 0.13
    assert max(abs(result.tau_error) for result in below) <= 1e-4  # figure 13
    assert max(result.f_error for result in below) <= 0.2


def test_where_it_converges_it_takes_two_or_three_iterations(swept: list[LagResult]) -> None:
    """Figures 11 and 12: E falls by hundreds of times where the lag is found and stays in pixels where it is not."""
    found = [result for result in swept if result.right]
    assert 1.5 <= np.median([result.converged_at for result in found if result.converged_at is not None]) <= 3.5
    assert all(min(result.distances) < 0.02 for result in found)
    assert all(result.distances[0] > 50.0 * min(result.distances) for result in found)
    wrong = [result for result in swept if not result.right]
    assert all(min(result.distances) > 5.0 and result.converged_at is None for result in wrong)


def test_on_uniform_rotation_e_falls_to_a_wrong_result() -> None:
    """Trajectory (a)."""
    results = sweep(trajectory_a, [0.05, 0.11, 0.31])
    for result in results:
        assert result.distances[-1] < result.distances[0]
        assert abs(result.tau_error) > 0.3 * result.tau
        assert result.f_error > 2.0
    assert "3 of 3 lags" in uniform_rotation_summary(results)


def test_on_near_planar_motion_the_lag_is_found_up_to_a_tenth_of_a_second() -> None:
    """Trajectory (b)."""
    results = sweep(trajectory_b, np.arange(0.01, 0.18, 0.01))
    limit = first_failure(results)
    assert 0.06 <= limit <= 0.18
    assert all(abs(result.tau_error) < 1e-4 and result.f_error < 0.2 for result in results if result.tau < limit)


def test_on_isotropic_motion_the_lag_is_found_to_a_millisecond() -> None:
    """Trajectory (c): faster motion, so that the linear interpolation of eq. 19 costs more."""
    results = sweep(trajectory_c, [0.01, 0.05, 0.09, 0.13, 0.29, 0.33, 0.37])
    assert 0.1 <= first_failure(results) <= 0.3
    assert all(abs(result.tau_error) < 1e-3 and result.f_error < 0.4 for result in results if result.tau < 0.1)


def test_a_lag_of_the_other_sign_is_found_too() -> None:
    assert paper_method(film(trajectory_1, -0.11)).tau_error == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_the_default_method_finds_lags_that_the_papers_method_does_not(name: str) -> None:
    """Its alignment, accepted or refused: on uniform rotation two lags are nearly as good."""
    for tau in (0.33, 3.0):
        found = default_method(film(TRAJECTORIES[name], tau))
        assert found.tau_error == pytest.approx(0.0, abs=1e-3)
        assert found.f_error < 0.5
    assert not paper_method(film(TRAJECTORIES[name], 2.0)).right


def test_the_noise_is_deterministic_and_of_the_given_std() -> None:
    exact, noisy, again = (film(trajectory_1, 0.11, noise) for noise in (0.0, 0.5, 0.5))
    np.testing.assert_array_equal(noisy.a, again.a)
    assert np.std(noisy.b - exact.b) == pytest.approx(0.5, rel=0.1)


def test_with_noise_equation_18_is_biased_to_the_middle_of_its_bin() -> None:
    assert bin_bias(2.1, seeds=3) > 1.5e-3
    assert abs(bin_bias(2.5, seeds=3)) < 1e-3
    assert bin_bias(2.9, seeds=3) < -1.5e-3


def test_each_iteration_brings_the_lines_closer_until_the_last() -> None:
    time = np.arange(0.0, 11.0, PERIOD)
    found = estimate_alternately(project(CAMERA_1, trajectory_1(time)), project(CAMERA_2, trajectory_1(time + 0.11)))
    distances = [iteration.distance for iteration in found.iterations]
    assert distances[1:-1] == sorted(distances[1:-1], reverse=True)
    assert found.distance == min(distances[1:])


def test_equation_11_rounds_towards_zero() -> None:
    assert [search_start(lag) for lag in (2.7, 0.3, 0.0, -0.3, -2.7)] == [2, 0, 0, 0, -2]


def test_equations_16_to_18_take_the_mean_of_the_fullest_bin() -> None:
    lags = np.array([3.2, 3.4, 3.9, 4.1, -7.0, np.nan, 12.5])
    assert overall_lag(lags) == pytest.approx((3.2 + 3.4 + 3.9) / 3)
    with pytest.raises(Refused):
        overall_lag(np.full(5, np.nan))


def test_equations_19_and_20_interpolate_between_two_frames() -> None:
    a = np.column_stack([np.arange(20.0), np.zeros(20)])
    b = np.column_stack([10.0 * np.arange(20), 5.0 * np.arange(20)])
    first, second, used = corresponding_points(a, b, 2.25)
    assert used.sum() == 17
    np.testing.assert_allclose(second, np.column_stack([10.0 * (first[:, 0] + 2.25), 5.0 * (first[:, 0] + 2.25)]))


def test_frames_without_a_marker_are_left_out() -> None:
    time = np.arange(0.0, 11.0, PERIOD)
    a, b = project(CAMERA_1, trajectory_1(time)), project(CAMERA_2, trajectory_1(time + 0.05))
    a[50:55], b[200:203] = np.nan, np.nan
    assert -estimate_alternately(a, b).lag * PERIOD == pytest.approx(0.05, abs=2e-4)


def _recorded(late: float) -> Recording:
    """Trajectory 1 as a recording of two cameras at 30 fps, camera two's frames ``late`` [s] within their interval."""
    cameras, tracks = {}, {}
    for name, placed, first in (("one", CAMERA_1, 0.0), ("two", CAMERA_2, late)):
        lens = Intrinsics(640, 480, np.diag([FOCAL, FOCAL, 1.0]))
        cameras[name] = RigCamera(name, (640, 480), 30.0, lens)
        time = first + np.arange(0.0, 11.0, PERIOD)
        size = np.full(len(time), np.nan)
        frame = np.arange(len(time))
        tracks[name, "m"] = Track(name, "m", frame, time, project(placed, trajectory_1(time)), size)
    return Recording(Rig(cameras), Observations(tracks))


@pytest.mark.parametrize("shift", [0.1, -0.12])
def test_a_clock_shift_is_recovered_from_frame_numbers_and_timestamps(shift: float) -> None:
    recording = _recorded(late=0.012)
    cameras = ("one", "two")
    assert most_common(recording) == ("one", "two", "m")
    assert run(recording, cameras, "m", shift).found == pytest.approx(shift, abs=2e-4)
    found, status = default_shift(recording, cameras, shift)
    assert status == "ok"
    assert found == pytest.approx(shift, abs=1e-3)


def test_on_real_tracks_the_method_converges_to_the_shift() -> None:
    """Figure 17: the spread of f_i shrinks; the end lies within the stamps' jitter of the shift."""
    recording = read_recording(DEFAULT_DATA)
    if recording is None:
        pytest.skip(f"no webcams/session in {DEFAULT_DATA}")
    one, two, label = most_common(recording)
    filmed = run(recording, (one, two), label, SHIFT)
    assert filmed.found == pytest.approx(SHIFT, abs=NEAR)
    shown = [filmed.iteration(n) for n in (0, 4, 9)]
    spreads = [float(np.nanstd(iteration.lags)) for _, iteration in filter(None, shown)]
    assert [n for n, _ in filter(None, shown)] == [0, 4, 9]
    assert spreads[2] < spreads[1] < spreads[0]
    assert abs(delay(recording, (one, two))) < NEAR


def test_absent_data_give_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert real_section(tmp_path, tmp_path) is None
    assert f"no webcams/session in {tmp_path}" in capsys.readouterr().out


def test_the_figures_are_drawn(tmp_path: Path, swept: list[LagResult]) -> None:
    few = {(name, method): swept for name in TRAJECTORIES for method in METHODS}
    drawn = [
        timing_figures.residuals(tmp_path, swept),
        timing_figures.errors(tmp_path, few, list(METHODS)),
        timing_figures.trajectories(tmp_path),
        timing_figures.real(tmp_path, run(_recorded(0.012), ("one", "two"), "m", 0.1), 0.0),
    ]
    for file in drawn:
        assert file is not None
        assert file.read_bytes().startswith(b"\x89PNG")
        assert 10_000 < file.stat().st_size < 120_000
