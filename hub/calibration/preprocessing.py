"""From a session to what the solvers take: smoothed tracks, raw rows, and who can't be used and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hub.bundle.problem import Rows
from hub.calibration.initialisation import Camera
from hub.trajectory.discrete import sampled_track
from hub.trajectory.image_tracks import SmoothTrack, Track, smooth_track, without_jumps
from protocols.geometry.camera import Intrinsics
from protocols.geometry.sphere_projection import outline_to_centre
from protocols.geometry.types import Floats
from protocols.session.observations import Observations
from protocols.session.rig import Rig, RigCamera

NO_INTRINSICS = "no intrinsics (matrix and distortions in rig.toml): run `syncline intrinsics`"


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Cameras that can be tried: smoothed tracks, raw rows; and those that can't, with the reason.

    lensless: cameras without measured intrinsics, of which by themselves only the timing can be found; their
    normalised coordinates are those of a nominal lens, and they are among the refused. paces: of cameras whose
    seconds are no seconds. outlines: by camera and label index, pixels (n, 2) as they were seen and sizes (n,) of
    cameras whose rows are centres of balls' outlines; ``rows`` holds them moved as far as the lens is known. All times
    in here are ``pace * (t_camera - epoch)``.
    """

    cameras: dict[str, Camera]
    rows: dict[str, list[Rows]]
    epochs: dict[str, float]
    labels: list[str]
    refused: dict[str, str]
    order: tuple[str, ...]
    shared_clock: bool = False
    warnings: tuple[str, ...] = ()
    lensless: dict[str, Camera] = field(default_factory=dict)
    paces: dict[str, float] = field(default_factory=dict)
    outlines: dict[str, dict[int, tuple[Floats, Floats]]] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """All cameras whose timing can be sought, in the rig's order."""
        return [name for name in self.order if name in self.cameras or name in self.lensless]

    def camera(self, name: str) -> Camera:
        """A camera of `names`."""
        return self.cameras[name] if name in self.cameras else self.lensless[name]

    def pace(self, name: str) -> float:
        """Seconds in here for one second that the camera's clock tells."""
        return self.paces.get(name, 1.0)

    def seen_through(self, name: str, lens: Intrinsics) -> list[Rows]:
        """The camera's rows as centres of balls, if they are outlines', once its lens is known."""
        seen = self.outlines.get(name)
        if not seen:
            return self.rows[name]
        return [replace(part, pixels=outline_to_centre(*seen[part.label], lens)) for part in self.rows[name]]

    def paced(self, names: list[str], factor: float) -> Prepared:
        """The same with the clocks of ``names`` made to run ``factor`` times as fast."""
        cameras, lensless, rows, paces = dict(self.cameras), dict(self.lensless), dict(self.rows), dict(self.paces)
        for name in names:
            camera = self.camera(name)
            scaled = replace(camera, tracks=_scaled(camera.tracks, factor))
            (cameras if name in cameras else lensless)[name] = scaled
            if name in rows:
                rows[name] = [replace(part, time=part.time * factor, stamp=part.stamps * factor) for part in rows[name]]
            paces[name] = self.pace(name) * factor
        return replace(self, cameras=cameras, lensless=lensless, rows=rows, paces=paces)


def prepare(rig: Rig, observations: Observations) -> Prepared:
    """Undistort and smooth every track; name the cameras that cannot be used."""
    refused: dict[str, str] = {}
    cameras: dict[str, Camera] = {}
    lensless: dict[str, Camera] = {}
    rows: dict[str, list[Rows]] = {}
    epochs: dict[str, float] = {}
    outlines: dict[str, dict[int, tuple[Floats, Floats]]] = {}
    labels = observations.labels
    start = min((float(track.time[0]) for track in observations.tracks.values()), default=0.0)
    warnings: list[str] = []
    for name, rig_camera in rig.cameras.items():
        tracks, jump = without_jumps(observations.of_camera(name))
        if jump:
            warnings.append(f"{name}: {jump}")
        if not tracks:
            refused[name] = "no observations"
            continue
        unknown = rig_camera.intrinsics is None or rig_camera.focal_std > 0.0
        if unknown:
            refused[name] = NO_INTRINSICS
            if rig.shared_clock:
                continue
        lens = rig_camera.intrinsics or nominal_lens(rig_camera)
        epoch = start if rig.shared_clock else min(float(track.time[0]) for track in tracks)
        smooth: dict[str, Track] = {}
        mine = []
        # A rolling shutter that was told: every row of the image has its own time, the camera's is the middle row's.
        # Rows that correspond by their times (a shared clock) keep them.
        readout = 0.0 if rig.shared_clock else rig_camera.readout or 0.0
        last_row = max(rig_camera.size[1] - 1, 1)
        for track in tracks:
            pixels = track.pixels
            if rig_camera.ball_outline:
                outlines.setdefault(name, {})[labels.index(track.label)] = pixels, track.size
                if not unknown:
                    pixels = outline_to_centre(pixels, track.size, lens)
            time = track.time + readout * (np.clip(track.pixels[:, 1], 0, last_row) / last_row - 0.5)
            normalised = lens.unproject(pixels)
            cleaned: Track | None
            if rig.shared_clock:
                cleaned = sampled_track(track.time, normalised, lens.focal, epoch)
            else:
                # False detections that jump down the image may overtake the next frame's.
                rising = time if bool((np.diff(time) > 0).all()) else track.time
                cleaned = smooth_track(rising, normalised, lens.focal, epoch)
            if cleaned is None:
                continue
            smooth[track.label] = cleaned
            use = np.ones(len(track), dtype=np.bool_)
            mine.append(Rows(-1, labels.index(track.label), time - epoch, pixels, use, stamp=track.time - epoch))
        if not smooth:
            few = f"too few connected observations ({sum(len(track) for track in tracks)} rows)"
            refused[name] = f"{NO_INTRINSICS}; and {few}" if unknown else few
            continue
        epochs[name] = epoch
        rows[name] = mine
        (lensless if unknown else cameras)[name] = Camera(name, lens, smooth, timed=rig_camera.readout is not None)
    return Prepared(
        cameras,
        rows,
        epochs,
        labels,
        refused,
        tuple(rig.cameras),
        rig.shared_clock,
        tuple(warnings),
        lensless,
        outlines=outlines,
    )


def nominal_lens(camera: RigCamera) -> Intrinsics:
    """A lens that any camera could have: good enough to speak of angles where only timing is sought."""
    width, height = camera.size
    focal = float(max(camera.size))
    matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return Intrinsics(width, height, matrix)


def _scaled(tracks: Mapping[str, Track], factor: float) -> dict[str, Track]:
    return {label: track.scaled(factor) if isinstance(track, SmoothTrack) else track for label, track in tracks.items()}


__all__ = ["NO_INTRINSICS", "Prepared", "nominal_lens", "prepare"]
