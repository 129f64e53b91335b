"""`syncline track`: tracks one target in a video, also while it is out of view."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from deploy.commands.common import (
    Flag,
    Json,
    NumberList,
    Scheduler,
    answer,
    check_file,
    check_rate,
    check_seed,
    closing_lines,
)
from deploy.offline.progress import progress_bar
from protocols.core.errors import InputError
from protocols.core.files import check_folder, remove_files, write_together

if TYPE_CHECKING:
    from edge.uav.base import Telemetry
    from edge.uav.georeference import Georeference
    from protocols.geometry.camera import Intrinsics
    from protocols.geometry.types import Floats


def track(
    video: Path,
    /,
    *,
    target: NumberList,
    out: Path,
    start: int = 0,
    rig: Path | None = None,
    telemetry: Path | None = None,
    model: Literal["ground", "paper", "plain"] = "ground",
    fps: float | None = None,
    overlay: Flag = False,
    csv_truth: Path | None = None,
    json: Json = False,
    scheduler: Scheduler = None,
    seed: int = 0,
) -> int:
    """Track one target in an aerial video, also while it is occluded or out of view, with uncertainty.

    The target may be a car, boat, bicycle or person, the view steep or oblique; neither lens nor telemetry is needed.
    Writes track.csv (one row per frame: visible, coasting or lost, with a std) and hypotheses.csv to --out.

    Example: syncline track flight.mp4 --target 312,200,44,20 --out tracked --overlay

    Parameters
    ----------
    video
        A video file, a folder of images sorted by name, or a .mcap log of a UAV agent with [images], which also
        contains the intrinsics and body_from_camera.
    target
        The target's bounding box in the first tracked frame, x,y,w,h in pixels; x,y is the top left corner.
    out
        Folder for the results.
    start
        Index of the first tracked frame; 0 is the first frame of the video.
    rig
        A rig.toml with the camera: matrix, distortions, fps, body_from_camera. One camera, or one named like the video.
    telemetry
        The drone's telemetry.csv: time,qw,qx,qy,qz[,north,east,down], on the video's clock, its attitudes compared with
        the rotation seen in the video; or a .tlog or .mcap, whose clock offset is estimated from that rotation. The
        ground model cannot use telemetry without matrix and body_from_camera in --rig, and refuses it.
    model
        ground: on the best frame of reference that the evidence supports: the ground plane, metric or up to scale, the
        stabilised or the plain image; track.csv's column basis has it. paper, plain: the paper's models of a car, for
        comparison.
    fps
        Frame rate, instead of the file's time stamps or rig.toml's.
    overlay
        Also write overlay.mp4: particles, road and estimate on a canvas larger than the image.
    csv_truth
        Ground truth CSV with frame,x,y[,width,height][,inside][,visible], x, y the centre in pixels: prints the track's
        scores.
    seed
        Seed of the tracker's random numbers.
    """
    check_folder(out)
    check_seed(seed)
    check_rate(fps)
    if start < 0:
        raise InputError(f"--start {start} is negative", remedy="give the index of a frame, 0 is the first")
    from deploy.evaluation.track_scores import read_truth, score
    from deploy.offline import track as tracking
    from deploy.offline.telemetry_files import LoggedFlightImages, open_recording
    from edge.devices.playback.video_writer import video_writer
    from edge.uav import tracker_factory

    for name, kind in ((tracking.TRACK, "a table"), (tracking.HYPOTHESES, "a table"), (tracking.OVERLAY, "a video")):
        check_file(out / name, kind, video, telemetry, csv_truth)
    box = tracking.parse_target(target)
    camera = tracking.choose_camera(rig, video) if rig is not None else None
    truth = read_truth(csv_truth) if csv_truth is not None else None
    lens = camera.intrinsics if camera is not None else None
    mounting = camera.body_from_camera if camera is not None else None
    warnings: list[str] = []
    rate = fps
    if rate is None and camera is not None and camera.fps > 0 and video.is_dir():
        rate = camera.fps
    recording, counted = open_recording(video, rate, lens)
    if isinstance(recording, LoggedFlightImages):
        lens = recording.lens
        mounting = recording.body_from_camera if mounting is None else mounting
    size = (recording.info.width, recording.info.height)
    count = tracking.count_frames(video) if counted is None else counted
    samples: tuple[Telemetry, ...] = ()
    georeference: Georeference | None = None
    if telemetry is not None:
        flight = _Flight(video, recording, rate, lens, mounting, start, count)
        samples, warnings, georeference = _samples(telemetry, flight, json, model == "ground")
    tracker = tracker_factory.make_tracker(model, size, lens, mounting, recording.info.fps, seed)
    rows: list[tracking.TrackedFrame] = []
    with ExitStack() as stack:
        progress = stack.enter_context(progress_bar(f"tracking in {video.name}", quiet=json))
        write = None
        if overlay:
            film = video_writer(out / tracking.OVERLAY, recording.info.fps, "leave out --overlay")
            write = stack.enter_context(film)
        stack.callback(recording.close)

        def frame_done(index: int) -> None:
            progress(f"frame {index}" + (f" of {count}" if count else ""), index / count if count else 0.0)

        for row in tracking.track_recording(
            recording,
            tracker,
            box,
            start=start,
            telemetry=samples,
            georeference=georeference,
            show=None if write is None else lambda image, tracked: write(tracking.draw(image, tracked)),
            progress=frame_done,
        ):
            # Particles and layers are only for the overlay, and would fill the memory for a long video.
            rows.append(replace(row, estimate=replace(row.estimate, particles=None, layers={})))
        if not overlay and (out / tracking.TRACK).exists():
            remove_files([out / tracking.OVERLAY])  # of an earlier result
        write_together(
            {
                out / tracking.TRACK: tracking.track_text(rows),
                out / tracking.HYPOTHESES: tracking.hypotheses_text(rows),
            }
        )
    if (
        model == "ground"
        and any(sample.position is not None for sample in samples)
        and not any(math.isfinite(row.estimate.north) for row in rows)
    ):
        why = "the images show no plane that the target moves on, or it is near the horizon"
        assert lens is not None  # else the telemetry is refused
        assert mounting is not None
        if not tracking.positions_fit(lens, mounting, samples, rows[0], box):
            needs = "metres, down the negative height above the ground, at which the target is 0.3 to 30 m long"
            why = f"they must be north, east, down in {needs}"
        warnings.append(f"{telemetry}: its positions were used in no frame: {why}")
    warnings += tracking.corners_for_a_box(box, size)
    warnings += [f"{video}: {text}" for text in recording.warnings]
    scores = score(rows, truth, size) if truth is not None else None
    return _summarise(out, rows, model, seed, overlay, warnings, scores, json)


class _Flight(NamedTuple):
    """A recording to which telemetry belongs. frames: their number; 0 = not known."""

    video: Path
    recording: Any
    rate: float | None
    lens: Intrinsics | None
    mounting: Floats | None
    start: int
    frames: int


@contextmanager
def _watched(what: str, flight: _Flight, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A function that shows how many frames of a flight's video are done."""
    with progress_bar(f"{what} {flight.video.name}", quiet=quiet) as progress:
        yield lambda frame: progress(f"frame {frame}", frame / flight.frames if flight.frames else 0.0)


def _samples(
    telemetry: Path, flight: _Flight, quiet: bool, needs_lens: bool
) -> tuple[tuple[Telemetry, ...], list[str], Georeference | None]:
    """The telemetry's samples, warnings, and what corrects positions by them, or says how uncertain they are.
    Raises InputError."""
    from deploy.offline import track as tracking
    from deploy.offline.telemetry_files import (
        Footage,
        LoggedFlightImages,
        align_to_video,
        check_attitudes,
        read_telemetry_log,
    )
    from edge.uav.georeference import Georeference
    from edge.uav.timing.telemetry_track import PRIOR_STD_S

    recording, count, warnings, aligned = flight.recording, flight.frames, [], False
    own_clock = telemetry.suffix.lower() in (".tlog", ".mcap")
    logged = isinstance(recording, LoggedFlightImages) and telemetry.resolve() == flight.video.resolve()
    source = recording.source if logged else None
    recorded = read_telemetry_log(telemetry, source) if own_clock else tracking.read_telemetry(telemetry)
    if needs_lens and (flight.lens is None or flight.mounting is None):
        what = "telemetry cannot be used without the camera's matrix and body_from_camera"
        raise InputError(what, file=telemetry, remedy="give both in --rig, or leave --telemetry out")
    if recorded.left_out:
        warnings.append(f"{telemetry}: {recorded.left_out} rows hold no sample and were left out")
    if recorded.back:
        what = f"its times go back {recorded.back} times, and were sorted"
        warnings.append(f"{telemetry}: {what}: of a clock that was set, rows of two times are mixed")
    if recorded.unused:
        what = f"its positions are not used, as it has {','.join(recorded.unused)} but not north,east,down"
        warnings.append(f"{telemetry}: {what}: give these three in metres, down 0 on the ground")
    samples = recorded.samples
    if not own_clock:
        end = count / recording.info.fps if count else float("inf")
        span = flight.start / recording.info.fps, end
        gaps = tracking.check_clock(samples, telemetry, *span)
        if flight.lens is not None and flight.mounting is not None:
            with _watched("comparing the telemetry with", flight, quiet) as done:
                footage = Footage(flight.video, flight.rate, flight.lens, flight.mounting, done)
                samples, found, aligned = check_attitudes(recorded, telemetry, footage)
            if aligned:
                gaps = tracking.check_clock(samples, telemetry, *span)
            warnings += found
        warnings += gaps
    elif logged:
        # The agent has already put both on one clock.
        samples = tuple(replace(sample, time=sample.time - recording.first_s) for sample in samples)
        aligned = True
    elif flight.lens is None or flight.mounting is None:
        samples = ()
    else:
        with _watched("looking for the telemetry's clock in", flight, quiet) as done:
            footage = Footage(flight.video, flight.rate, flight.lens, flight.mounting, done)
            samples, found = align_to_video(recorded, telemetry, footage)
        warnings += found
        aligned = True
    if flight.lens is None or flight.mounting is None:
        return samples, warnings, None
    return samples, warnings, Georeference(flight.lens, flight.mounting, 0.0 if aligned else PRIOR_STD_S)


def _summarise(
    out: Path,
    rows: list[Any],
    model: str,
    seed: int,
    overlay: bool,
    warnings: list[str],
    scores: dict[str, float | int] | None,
    as_json: bool,
) -> int:
    """Print the summary: number of frames by state and by frame of reference, scores, and output files."""
    from deploy.offline.track import basis_summary

    states = Counter(row.estimate.state.value for row in rows)
    bases = basis_summary(rows)
    names = ["track.csv", "hypotheses.csv", *(["overlay.mp4"] if overlay else [])]
    document: dict[str, Any] = {
        "out": str(out),
        "files": names,
        "model": model,
        "seed": seed,
        "first_frame": rows[0].frame,
        "frames": len(rows),
        **{state: states.get(state, 0) for state in ("visible", "coasting", "lost")},
        "basis": bases,
        "warnings": warnings,
    }
    if scores is not None:
        document["scores"] = scores
    parts = ", ".join(f"{states.get(state, 0)} {state}" for state in ("visible", "coasting", "lost"))
    lines = [
        f"{len(rows)} frames from {rows[0].frame}: {parts}",
        *(f"{basis}: {entry['frames']} frames; {entry['reason']}" for basis, entry in bases.items()),
        *(f"{name}: {v}" if isinstance(v, int) else f"{name}: {v:.3f}" for name, v in (scores or {}).items()),
    ]
    return answer(document, [*lines, *closing_lines(warnings, [out / name for name in names])], as_json)
