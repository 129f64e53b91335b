"""Preprocessing of a session: undistorted, smoothed tracks and raw rows; cameras that cannot be used, with reasons."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import betainc

from hub.bundle.initialisation import MIN_KNOT_SPACING, CameraInput
from hub.bundle.problem import LensPrior, TrackObservations
from hub.trajectory.discrete import sampled_track
from hub.trajectory.image_tracks import ImageTrack, SmoothTrack, smooth_track, without_clock_steps
from protocols.geometry.camera import Intrinsics, outline_to_centre
from protocols.geometry.types import Floats
from protocols.session.observations import Observations, Track
from protocols.session.rig import Rig, RigCamera

_MAX_STD_RATIO = 10.0
"""Ratio of a row's stated std to the camera's typical one beyond which it is not believed: lens errors stay."""
_LEAST_KNOT_SPACING_S = 0.15
"""Of paths: the time constant of a silhouette's errors, whose correlation is 0.5 after 0.1 s and 0.3 after 0.2 s.
Cross-validation takes them for motion: with knots 0.06 to 0.12 s apart clocks of seven rendered rooms were 10 ms off
(rms), at stds of 2; with 0.15, 0.2 and 0.3 s by 4 to 5, at stds of 2 to 3."""
NO_INTRINSICS = "no intrinsics (matrix and distortions in rig.toml): run `syncline intrinsics`"

CELL_PX = 6.0  # about a fixed pixel: three sigma of a poor detector
_JUMP_PX = 60.0  # between rows is a jump if longer; a target that leaves a place of rest is seen nearer, above 3 fps
_CELL_SHARE = CELL_PX / _JUMP_PX  # of a target's rows within a jump of a pixel that it passes: its path is a line there
_RUN = 3  # rows without a jump are a target in motion: of 30 % false rows all over the image, one in 10^4 begins one
_FALSE_ALARM = 1e-4  # of a track
_LONGEST_REPEAT_S = 0.5  # from a new image to the next: no camera films more slowly, and a target that rests is longer
_LEAST_REPEATS = 0.01  # share of a camera's rows that is worth a warning: pixels of one decimal are equal by chance


@dataclass(frozen=True, slots=True, eq=False)
class PreparedSession:
    """Input of the solvers: usable cameras with smoothed tracks and raw rows, and refused cameras with reasons.

    uncalibrated: cameras without measured intrinsics, of which only the timing can be estimated without
    self-calibration; their normalised coordinates are those of nominal intrinsics, and they are among the refused.
    time_origins: by camera, subtracted from its times [s]. time_scales: by camera, correction of a wrong frame rate.
    outlines: by camera and label index, observed pixels (n, 2) and sizes (n,) of cameras whose rows are centres of
    balls' outlines; ``rows`` holds them corrected to the balls' centres as far as the lens is known. All times in here
    are ``time_scale * (t_camera - time_origin)``.
    """

    cameras: dict[str, CameraInput]
    rows: dict[str, list[TrackObservations]]
    time_origins: dict[str, float]
    labels: list[str]
    refused: dict[str, str]
    camera_order: tuple[str, ...]
    shared_clock: bool = False
    warnings: tuple[str, ...] = ()
    uncalibrated: dict[str, CameraInput] = field(default_factory=dict)
    time_scales: dict[str, float] = field(default_factory=dict)
    outlines: dict[str, dict[int, tuple[Floats, Floats]]] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """All cameras whose timing can be estimated, in the rig's order."""
        return [name for name in self.camera_order if name in self.cameras or name in self.uncalibrated]

    def camera(self, name: str) -> CameraInput:
        """A camera of `names`."""
        return self.cameras[name] if name in self.cameras else self.uncalibrated[name]

    def time_scale(self, name: str) -> float:
        """Seconds in here per second of the camera's clock."""
        return self.time_scales.get(name, 1.0)

    def rows_through(self, name: str, lens: Intrinsics) -> list[TrackObservations]:
        """The camera's rows for the intrinsics ``lens``: ball outlines are corrected to the balls' centres."""
        seen = self.outlines.get(name)
        if not seen:
            return self.rows[name]
        return [replace(part, pixels=outline_to_centre(*seen[part.label], lens)) for part in self.rows[name]]

    def with_time_scale(self, names: list[str], factor: float) -> PreparedSession:
        """The same with the times of ``names`` multiplied by ``factor``."""
        cameras, uncalibrated, rows, time_scales = (
            dict(self.cameras),
            dict(self.uncalibrated),
            dict(self.rows),
            dict(self.time_scales),
        )
        for name in names:
            camera = self.camera(name)
            tracks = {
                k: one.scaled(factor) if isinstance(one, SmoothTrack) else one for k, one in camera.tracks.items()
            }
            (cameras if name in cameras else uncalibrated)[name] = replace(camera, tracks=tracks)
            if name in rows:
                rows[name] = [replace(part, time=part.time * factor, stamp=part.stamps * factor) for part in rows[name]]
            time_scales[name] = self.time_scale(name) * factor
        return replace(self, cameras=cameras, uncalibrated=uncalibrated, rows=rows, time_scales=time_scales)


def prepare(rig: Rig, observations: Observations) -> PreparedSession:
    """Undistort and smooth every track; cameras that cannot be used are refused with a reason."""
    refused: dict[str, str] = {}
    cameras: dict[str, CameraInput] = {}
    uncalibrated: dict[str, CameraInput] = {}
    rows: dict[str, list[TrackObservations]] = {}
    time_origins: dict[str, float] = {}
    outlines: dict[str, dict[int, tuple[Floats, Floats]]] = {}
    labels = observations.labels
    start = min((float(track.time[0]) for track in observations.tracks.values()), default=0.0)
    warnings: list[str] = []
    is_person = rig.metadata.get("target") == "person"

    def take(name: str, rig_camera: RigCamera) -> None:
        tracks, clock_step = without_clock_steps(observations.of_camera(name))
        if clock_step:
            warnings.append(f"{name}: {clock_step}")
        if not rig.shared_clock:  # with one, nothing need move smoothly
            tracks = [
                one for track in _without_repeats(tracks, warnings) if len(one := _without_clutter(track, warnings))
            ]
        if not tracks:
            refused[name] = "no observations"
            return
        is_uncalibrated = not rig_camera.is_measured
        if is_uncalibrated:
            refused[name] = NO_INTRINSICS
            if rig.shared_clock:
                return
        lens = rig_camera.intrinsics or nominal_intrinsics(rig_camera)
        time_origin = start if rig.shared_clock else min(float(track.time[0]) for track in tracks)
        smooth: dict[str, ImageTrack] = {}
        mine = []
        # Given rolling-shutter readout: every image row has its own time; the frame's time is that of the middle row.
        # With a shared clock, observations correspond by equal times, which are kept.
        readout = 0.0 if rig.shared_clock else rig_camera.readout or 0.0
        for track in tracks:
            pixels = track.pixels
            if rig_camera.ball_outline:
                outlines.setdefault(name, {})[labels.index(track.label)] = pixels, track.size
                if not is_uncalibrated:
                    pixels = outline_to_centre(pixels, track.size, lens)
            time = track.time + readout * lens.row_offset(track.pixels)
            normalised = lens.unproject(pixels)
            relative = _relative_stds(track, tracks)
            cleaned: ImageTrack | None
            if rig.shared_clock:
                cleaned = sampled_track(track.time, normalised, lens.focal, time_origin)
            else:
                # With a rolling shutter a false detection low in the image may get a later time than the next frame's.
                rising = time if bool((np.diff(time) > 0).all()) else track.time
                cleaned = smooth_track(rising, normalised, lens.focal, time_origin, relative)
            if cleaned is None:
                continue
            smooth[track.label] = cleaned
            use = np.ones(len(track), dtype=np.bool_)
            mine.append(
                TrackObservations(
                    -1,
                    labels.index(track.label),
                    time - time_origin,
                    pixels,
                    use,
                    stamp=track.time - time_origin,
                    relative_std=relative,
                )
            )
        if not smooth:
            few = f"too few connected observations ({sum(len(track) for track in tracks)} rows)"
            refused[name] = f"{NO_INTRINSICS}; and {few}" if is_uncalibrated else few
            return
        time_origins[name] = time_origin
        rows[name] = mine
        focal_std = 0.0 if is_uncalibrated else rig_camera.focal_std
        (uncalibrated if is_uncalibrated else cameras)[name] = CameraInput(
            name,
            lens,
            smooth,
            LensPrior(lens.focal, focal_std) if focal_std else None,
            readout_given=rig_camera.readout is not None,
            # Those of a person's ends are ours, of any detector: only their ratio is meant.
            stated_std=0.0 if is_person else _typical_std(tracks),
            least_spacing=_LEAST_KNOT_SPACING_S if is_person else MIN_KNOT_SPACING,
        )

    for name, rig_camera in rig.cameras.items():
        try:
            take(name, rig_camera)
        except (ValueError, ArithmeticError, IndexError, np.linalg.LinAlgError) as error:
            # Whatever is wrong with one camera's numbers is a reason to refuse that camera, not the session.
            refused[name] = f"its rows or its lens cannot be used ({type(error).__name__}: {error})"[:300]
    return PreparedSession(
        cameras,
        rows,
        time_origins,
        labels,
        refused,
        tuple(rig.cameras),
        rig.shared_clock,
        tuple(warnings),
        uncalibrated,
        outlines=outlines,
    )


def _without_repeats(tracks: list[Track], warnings: list[str]) -> list[Track]:
    """A camera's tracks without rows at exactly the pixels of the row before; ``warnings`` gets their share.

    A camera that is short of light, or a copy at another frame rate, sends the last image again under a new time: such
    rows are always late. Whole and half pixels repeat by themselves, and so does a target that rests without noise.
    """
    kept = list[Track]()
    for track in tracks:
        is_new = np.r_[True, (np.diff(track.pixels, axis=0) != 0.0).any(axis=1)]
        run = np.cumsum(is_new) - 1
        rests = np.diff(track.time[np.r_[np.flatnonzero(is_new), -1]])[run] > _LONGEST_REPEAT_S
        is_coarse = not (2.0 * track.pixels % 1.0).any()
        kept.append(track if is_coarse else track.select(is_new | rests))
    every = sum(map(len, tracks))
    repeats = every - sum(map(len, kept))
    if repeats > _LEAST_REPEATS * every:
        text = f"{repeats / every:.0%} of its frames repeat the one before and were left out"
        warnings.append(f"{tracks[0].camera}: {text}")
    return kept


def _without_clutter(track: Track, warnings: list[str]) -> Track:
    """The track without the rows at fixed pixels that are no target; ``warnings`` gets what was left out."""
    every = len(track)
    while len(track) and (spot := static_clutter(track.pixels)) is not None:
        at = np.hypot(*(track.pixels - spot).T) <= CELL_PX
        warnings.append(
            f"{track.camera}: {at.sum()} of {every} rows ({at.sum() / every:.1%}) are at pixel ({spot[0]:.0f}, "
            f"{spot[1]:.0f}), again and again while the target moves elsewhere: a lamp? They are left out; cover it"
        )
        track = track.select(~at)
    return track


def _typical_std(tracks: list[Track]) -> float:
    """Geometric mean of the stds [px] that the detector states for a camera's rows; 0 without any.

    The median of rows half of which are worse than the others would be that of either half; from it on, a std that
    stands for "unknown" counts as any that is not believed.
    """
    known = np.concatenate([np.zeros(0), *(one.std for one in tracks if one.std is not None)])
    known = known[known > 0.0]
    if not len(known):
        return 0.0
    median = float(np.median(known))
    return float(np.exp(np.log(np.clip(known, median / _MAX_STD_RATIO, median * _MAX_STD_RATIO)).mean()))


def _relative_stds(track: Track, tracks: list[Track]) -> Floats | None:
    """Stds (n,) of a track's rows by the detector, over the camera's typical one; None if it states none.

    Only ratios count: the noise of a camera is estimated from its residuals.
    """
    typical = _typical_std(tracks)
    if track.std is None or typical <= 0.0:
        return None
    std = np.where(track.std > 0.0, track.std, typical)
    return np.clip(std / typical, 1.0 / _MAX_STD_RATIO, _MAX_STD_RATIO)


def nominal_intrinsics(camera: RigCamera) -> Intrinsics:
    """Nominal intrinsics (focal length = the larger image side): sufficient where only timing is estimated."""
    width, height = camera.size
    focal = float(max(camera.size))
    matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return Intrinsics(width, height, matrix)


def static_clutter(x: Floats) -> Floats | None:
    """The pixel (2,) of rows (n, 2) [px], by time, with most jumps to it, if it is clutter and no target.

    A target arrives at a pixel, rests and leaves through its neighbourhood; one that is too fast for the camera to show
    that is as often beside it as its size says, and one on a closed path comes from the same place each time. So the
    different places of a moving target before jumps to the pixel, and all jumps to beside it, have binomial odds.
    """
    begins = np.flatnonzero(np.r_[True, np.hypot(*(x[1:] - x[:-1]).T) > _JUMP_PX])
    least = np.log(_FALSE_ALARM / len(begins)) / np.log(_CELL_SHARE)
    if len(begins) <= least:
        return None
    low, high = (limit.reduceat(x, begins, axis=0) for limit in (np.minimum, np.maximum))
    rests = np.r_[False, (high - low).max(axis=1)[1:] <= 2.0 * CELL_PX]
    places, is_moving = 0.5 * (low + high)[rests], np.diff(begins, prepend=-_RUN)[rests] >= _RUN
    origin = np.rint(x[begins[rests] - 1] / (2.0 * CELL_PX)) @ [1.0, 1j]
    _, cell, count = np.unique(np.rint(places / (2.0 * CELL_PX)), axis=0, return_inverse=True, return_counts=True)
    for one in np.argsort(-count, kind="stable")[: np.count_nonzero(count > 0.5 * least)]:
        spot = np.median(places[cell.ravel() == one], axis=0)
        distance = np.hypot(*(places - spot).T)
        here = len(np.unique(origin[(distance <= CELL_PX) & is_moving]))
        beside = np.count_nonzero((distance > CELL_PX) & (distance <= _JUMP_PX))
        if here > least and betainc(here, beside + 1, _CELL_SHARE) * len(begins) < _FALSE_ALARM:
            return np.asarray(spot)
    return None
