"""`syncline follow`: follows people or vehicles through all cameras, offline."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Literal

from deploy.commands.common import Json, NumberList, Scheduler, answer, check_range, closing_lines, command_line
from deploy.offline.progress import progress_bar
from protocols.core.errors import InputError, Refused
from protocols.core.files import check_folder, write_together


def follow(
    session: Path,
    /,
    *,
    calibration: Path,
    out: Path,
    kind: Literal["person", "vehicle"] = "person",
    observations: Path | None = None,
    detector: str | None = None,
    fps: float | None = None,
    truth: Path | None = None,
    area: NumberList | None = None,
    crops: Path | None = None,
    json: Json = False,
    scheduler: Scheduler = None,
    seed: int = 0,
) -> int:
    """Follow people or vehicles through all cameras of a calibrated rig, offline.

    Writes tracks.csv (time,id,kind,state,x,y,z,height,std), report.html and result.json to --out. Times are on the
    calibration's reference clock, places in its world and units; x, y, z is the foot point; of vehicles, the
    middle. An id is one person for as long as the data allow. Exit status 3 if there is nobody to follow.

    Videos are named after their cameras. People or vehicles are first detected in each, in several processes; the
    detections are kept in --out as detections.mcap, which can be followed or replayed again.

    Example: syncline follow my-session --calibration out/calibration.toml --out followed

    Example: syncline follow my-videos --calibration out/calibration.toml --out followed --crops followed/crops

    Example: syncline follow boxes.csv --calibration calibration.toml --out followed --truth truth.csv --area -3,9,-9,27

    Parameters
    ----------
    session
        A folder with observations.csv or boxes.csv (camera,frame,time,x,y,width,height), such a file, a .mcap log that
        Syncline recorded, or a folder of videos.
    calibration
        The calibration.toml that `syncline calibrate` wrote: lenses, poses and clocks.
    out
        Folder for the results.
    kind
        What to follow. Detections of other kinds are left out.
    observations
        Another file of detections to use instead of the session's own; of videos, with the number of the decoded frame
        from 0 as frame and its presentation time.
    detector
        For videos: person, vehicle, a detector that another package registers, or a network's .toml file. Default: what
        moves before the background. With it, the videos of a folder are used even if observations lie beside them.
    fps
        Rows a second [Hz]. Default: a row at each frame of the reference camera, or at each time of a shared clock.
    truth
        True positions, frame,person,x,y or time,person,x,y (any of them with z), in the calibration's world and units:
        adds MODA, MOTA, IDF1 and HOTA to the results. Matches are within 0.5 m on the ground. A truth that fits the
        tracks in other units, another world or at other times alone is refused. Needs TrackEval: pip install --no-deps
        trackeval
    area
        With --truth: x0,x1,y0,y1, the part of the ground that was annotated; nothing outside counts.
    crops
        A folder for pictures of the heads, faces and torsos of the followed people, one folder a track. Needs videos,
        or a log with pictures.
    seed
        Seed of detectors that use random numbers; it stands in result.json.
    """
    check_folder(out)
    check_range("--fps", fps, 0.01, 1000.0, "give the rows a second, 0.01 to 1000")
    if area is not None and truth is None:
        raise InputError("--area goes with --truth", remedy="leave it out, or give --truth truth.csv")
    if crops is not None:
        check_folder(crops)
        if kind != "person":
            raise InputError("--crops shows heads and torsos of people", remedy="leave it out for vehicles")
    from deploy.evaluation import tracking_scores as scoring
    from deploy.offline.follow.calibration import read_given_calibration
    from deploy.offline.follow.crops import check_pictures, write_crops
    from deploy.offline.follow.report import follow_report
    from deploy.offline.follow.results import REPORT, RESULT, TRACKS, result_document, result_text, tracks_text
    from deploy.offline.follow.source import read_follow_input
    from deploy.offline.follow.units import boxes_from_above, unlikely_size
    from hub.tracking.offline import follow as follow_observations
    from protocols.core.clocks import NANOSECONDS
    from protocols.session.rig import METRES_PER_UNIT

    began = _cpu_seconds()
    known = read_given_calibration(calibration)
    limits = None if area is None else scoring.parse_area(area)
    if truth is not None:
        if known.calibration.scale != "metric":
            what = "the calibration has no metric scale, and matches are within 0.5 m"
            raise InputError(what, file=calibration, remedy="give the rig a distance, or leave out --truth")
        scoring.check_level(known.up, calibration)
        stated = scoring.read_ground_truth(truth, None)  # reported before minutes of detection
        if limits is not None:
            scoring.check_area(stated, limits)
        scoring.trackeval_metrics()
    with progress_bar(f"reading {session.name}", quiet=json) as progress:
        source = read_follow_input(
            session,
            known,
            kind,
            out,
            observations=observations,
            detector=detector,
            fps=fps,
            seed=seed,
            progress=progress,
        )
    if crops is not None:
        check_pictures(source, session)
    with progress_bar(f"following through {session.name}", quiet=json) as progress:
        result = follow_observations(
            source.observations,
            known.calibration,
            source.times_ns,
            up=known.up,
            progress=lambda share: progress("", share),
        )
    if not result.tracks:
        count = sum(len(message.detections) for message in source.observations)
        raise Refused(
            f"none of {count} detections made a track: no two cameras see a {kind} at one place for long enough; check "
            "that the calibration is of these cameras, its units, time offsets, and `up`"
            + boxes_from_above(source.observations, known),
            warnings=result.warnings,
        )
    times = [time_ns / NANOSECONDS for time_ns in source.times_ns]
    scores = None
    warnings = [*source.warnings, *result.warnings]
    if kind == "vehicle":
        warnings += unlikely_size(result.tracks, source.observations, known)
    if truth is not None:
        units_per_m = 1.0 / METRES_PER_UNIT[known.calibration.units]
        scoring.check_level(result.up, calibration)
        given = scoring.read_ground_truth(truth, source.frame_times(known))
        scores = scoring.score_tracks(given, result.tracks, times, units_per_m, limits)
    command = command_line()
    written = [out / name for name in (TRACKS, RESULT, REPORT)]
    if crops is not None:
        with progress_bar("cutting out heads and torsos", quiet=json) as progress:
            count, lacking = write_crops(crops, source, result, known, progress)
        warnings += lacking if count else [*lacking, "no picture shows a followed person large enough for --crops"]
        written.append(crops)
    document = result_document(
        result,
        known,
        kind=kind,
        command=command,
        times=times,
        cpu_seconds=_cpu_seconds() - began,
        warnings=warnings,
        scores=scores,
        seed=seed,
    )
    write_together(
        {
            out / TRACKS: tracks_text(result.tracks),
            out / RESULT: result_text(document),
            out / REPORT: follow_report(result, source, known, document),
        }
    )
    spent, seconds = _cpu_seconds(), times[-1] - times[0]
    lines = [f"{len(result.tracks)} tracks in {seconds:.1f} s, {len(result.cameras)} cameras, {spent:.1f} s of CPU"]
    for name, camera in result.cameras.items():
        used = f"{100 * camera.used:.0f} % used"
        lines.append(f"{name}: {camera.frames} frames, {camera.detections} detections, {used}")
    if scores is not None:
        values = {name.upper(): scores[name] for name in ("moda", "mota", "idf1", "hota")}
        lines.append(", ".join(f"{name} {'-' if value is None else f'{value:.3f}'}" for name, value in values.items()))
    return answer(document, [*lines, *closing_lines(warnings, written)], json)


def _cpu_seconds() -> float:
    """CPU time [s] of this process and of those that it has ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
