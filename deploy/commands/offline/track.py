"""`syncline track`: tracks one target in a video, also while it is out of view."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from deploy.offline.progress import progress_bar
from protocols.core.errors import EXIT_DONE, InputError
from protocols.core.files import check_folder, write_together


def track(
    video: Path,
    /,
    *,
    target: str,
    out: Path,
    start: int = 0,
    rig: Path | None = None,
    telemetry: Path | None = None,
    model: Literal["ground", "paper", "plain"] = "ground",
    fps: float | None = None,
    overlay: Annotated[bool, Parameter(negative="")] = False,
    csv_truth: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
    scheduler: str | None = None,
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
        The drone's telemetry.csv: time,qw,qx,qy,qz[,north,east,down], on the video's clock; or a .tlog or .mcap, whose
        clock offset is estimated from the rotation seen in the video. The ground model cannot use telemetry without
        matrix and body_from_camera in --rig, and refuses it.
    model
        ground: on the best frame of reference that the evidence supports: the ground plane, metric or up to scale, the
        stabilised or the plain image; track.csv's column basis has it. paper, plain: the paper's models of a car, for
        comparison.
    fps
        Frame rate, instead of the file's time stamps or rig.toml's.
    overlay
        Also write overlay.mp4: particles, road and estimate on a canvas larger than the image.
    csv_truth
        Ground truth CSV with frame,x,y[,width,height][,inside][,visible]: prints the track's scores.
    json
        Print a summary as JSON.
    scheduler
        Runs this command over many videos on dask: an address, a scheduler's file, or a number of processes on this
        machine. The video is then a folder of videos, or a .txt file with one and its own options a line; --out is a
        folder. Called again, it does what is left.
    seed
        Seed of the tracker's random numbers.
    """
    check_folder(out)
    _check(video, start, fps, seed)
    from deploy.evaluation.track_scores import read_truth, score
    from deploy.offline import track as tracking
    from deploy.offline.track_log import LoggedFlightImages, open_recording
    from deploy.offline.track_overlay import Overlay
    from edge.uav import tracker_factory
    from edge.uav.base import Telemetry

    box = tracking.parse_target(target)
    camera = tracking.choose_camera(rig, video) if rig is not None else None
    truth = read_truth(csv_truth) if csv_truth is not None else None
    lens = camera.intrinsics if camera is not None else None
    mounting = camera.body_from_camera if camera is not None else None
    warnings: list[str] = []
    samples: tuple[Telemetry, ...] = ()
    own_clock = telemetry is not None and telemetry.suffix.lower() in (".tlog", ".mcap")
    recorded: tracking.TelemetryFile | None = None
    if telemetry is not None and own_clock:
        from deploy.offline.telemetry_files import read_telemetry_log

        recorded = read_telemetry_log(telemetry)
    elif telemetry is not None:
        recorded = tracking.read_telemetry(telemetry)
    rate = fps
    if rate is None and camera is not None and camera.fps > 0 and video.is_dir():
        rate = camera.fps
    recording, counted = open_recording(video, rate, lens)
    same_log = False
    if isinstance(recording, LoggedFlightImages):
        lens = recording.lens
        mounting = recording.body_from_camera if mounting is None else mounting
        same_log = telemetry is not None and telemetry.resolve() == video.resolve()
    if recorded is not None and telemetry is not None:
        if model == "ground" and (lens is None or mounting is None):
            what = "telemetry cannot be used without the camera's matrix and body_from_camera"
            raise InputError(what, file=telemetry, remedy="give both in --rig, or leave --telemetry out")
        if recorded.left_out:
            warnings.append(f"{telemetry}: {recorded.left_out} rows hold no sample and were left out")
        samples = recorded.samples
    size = (recording.info.width, recording.info.height)
    count = tracking.count_frames(video) if counted is None else counted
    if recorded is not None and same_log and isinstance(recording, LoggedFlightImages):
        # The agent has already put both on one clock.
        first_s = recording.first_s
        samples = tuple(replace(sample, time=sample.time - first_s) for sample in recorded.samples)
    elif recorded is not None and own_clock:
        samples = ()
        if lens is not None and mounting is not None:
            from deploy.offline.telemetry_files import align_to_video

            with progress_bar(f"looking for the telemetry's clock in {video.name}", quiet=json) as progress:
                samples, line = align_to_video(
                    recorded, video, rate, lens, mounting, lambda i: progress(f"frame {i}", i / count if count else 0.0)
                )
            if not samples:
                warnings.append(line)
    elif recorded is not None and telemetry is not None:
        end = count / recording.info.fps if count else float("inf")
        tracking.check_clock(recorded, telemetry, start / recording.info.fps, end)
    tracker = tracker_factory.make_tracker(model, size, lens, mounting, recording.info.fps, seed)
    rows: list[tracking.TrackedFrame] = []
    with ExitStack() as stack:
        progress = stack.enter_context(progress_bar(f"tracking in {video.name}", quiet=json))
        film = stack.enter_context(Overlay(out / tracking.OVERLAY, recording.info.fps)) if overlay else None
        stack.callback(recording.close)

        def frame_done(index: int) -> None:
            progress(f"frame {index}" + (f" of {count}" if count else ""), index / count if count else 0.0)

        for row in tracking.track_recording(
            recording,
            tracker,
            box,
            start=start,
            telemetry=samples,
            show=film.show if film is not None else None,
            progress=frame_done,
        ):
            # Particles and layers are only for the overlay, and would fill the memory for a long video.
            rows.append(tracking.without_overlay_data(row))
        write_together(
            {
                out / tracking.TRACK: tracking.track_text(rows),
                out / tracking.HYPOTHESES: tracking.hypotheses_text(rows),
            }
        )
        if film is not None:
            film.finish()
    if count and rows[-1].frame + 1 < count:
        warnings.append(f"{video}: {rows[-1].frame + 1} of {count} frames could be decoded")
    if recording.repaired:
        warnings.append(f"{video}: {recording.repaired} frames have no usable time stamp")
    scores = score(rows, truth, size) if truth is not None else None
    _print_summary(out, rows, model, seed, overlay, warnings, scores, json)
    return EXIT_DONE


def _check(video: Path, start: int, fps: float | None, seed: int) -> None:
    if start < 0:
        raise InputError(f"--start {start} is negative", remedy="give the index of a frame, 0 is the first")
    if seed < 0:
        raise InputError(f"--seed {seed} is negative", remedy="give 0 or more")
    if fps is not None and not 0.1 <= fps <= 10_000:
        raise InputError(f"--fps {fps:g} is out of range", remedy="give the frame rate in Hz")


def _print_summary(
    out: Path,
    rows: list[Any],
    model: str,
    seed: int,
    overlay: bool,
    warnings: list[str],
    scores: dict[str, float | int] | None,
    as_json: bool,
) -> None:
    """Print the summary: number of frames by state and by frame of reference, scores, and output files."""
    from deploy.offline.track import basis_summary

    states = Counter(row.estimate.state.value for row in rows)
    bases = basis_summary(rows)
    names = ["track.csv", "hypotheses.csv", *(["overlay.mp4"] if overlay else [])]
    if as_json:
        import json

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
        print(json.dumps(document, allow_nan=False))
        return
    parts = ", ".join(f"{states.get(state, 0)} {state}" for state in ("visible", "coasting", "lost"))
    print(f"{len(rows)} frames from {rows[0].frame}: {parts}")
    for basis, entry in bases.items():
        print(f"{basis}: {entry['frames']} frames; {entry['reason']}")
    for name, value in (scores or {}).items():
        print(f"{name}: {value}" if isinstance(value, int) else f"{name}: {value:.3f}")
    for warning in warnings:
        print(f"warning: {warning}")
    print(f"written: {', '.join(str(out / name) for name in names)}")
