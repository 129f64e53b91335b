"""`syncline sync`: reference times of all frames, and synchronised copies of the videos."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from deploy.commands.common import Json, UnusedSeed, answer, check_range, closing_lines
from deploy.offline.progress import progress_bar
from protocols.core.errors import InputError, Refused

if TYPE_CHECKING:
    from protocols.core.acceptance import PairReport


def sync(
    folder: Path,
    /,
    *,
    calibration: Path | None = None,
    out: Path,
    videos: Literal["retime", "trim", "none"] = "retime",
    fps: float | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Compute the time of every frame of every video on one reference clock, and write synchronised videos.

    Writes one CAMERA.csv (frame,time,reference_time in seconds) per video, and CAMERA.mp4 over their common time span.
    retime: all videos have the same constant frame rate and length, and equal frame numbers show the same time;
    synchronised.csv lists the source frames. trim: every source frame once, stamped with its reference time. Audio is
    dropped. Needs the extra "video" (PyAV). Exit status 3 if the videos do not overlap in time.

    Lags need no lenses and no poses: without --calibration, or with the result.json of a calibration that was refused,
    the videos are aligned by timing alone.

    Example: syncline sync my-videos --out synchronised

    Example: syncline sync my-videos --calibration out/calibration.toml --out synchronised

    Parameters
    ----------
    folder
        The videos that were calibrated, each named after its camera.
    calibration
        The calibration.toml, or result.json, of these videos. Default: what moves in them is detected, and the lags are
        estimated, as by `syncline calibrate`, into timing/ in --out.
    out
        Folder for the results.
    videos
        retime, trim, or none (only the tables).
    fps
        Frame rate of retimed videos; default: the highest frame rate of the videos.
    """
    from protocols.core.files import check_folder, file_in, remove_files, write_together

    check_folder(out)
    check_range("--fps", fps, 0.1, 1000.0, "give the frame rate in Hz")
    if fps is not None and videos == "trim":
        raise InputError("--fps cannot be used with --videos trim", remedy="leave one of the two out")
    if out.exists() and folder.exists() and out.resolve() == folder.resolve():
        raise InputError("--out is the folder of the videos", file=out, remedy="choose another --out")
    from deploy.offline import sync as syncing
    from deploy.offline.video_folder import list_videos
    from edge.devices.playback.video_reader import VideoReader, has_pyav
    from protocols.session.calibration import csv_cell

    if not has_pyav():
        raise InputError("`sync` needs PyAV, which is not installed", remedy="pip install 'syncline[video]'")
    listed, warnings = list_videos(folder)
    found = {}
    for file in listed:
        try:
            found[file.camera] = VideoReader(file.path)
        except InputError as error:
            warnings.append(f"{file.path.name}: {error.what}; left out")
    reasons: dict[str, str] = {}
    if calibration is None:
        calibration, reasons = _estimate(folder, out / "timing", json)
    reference, known, stds, refused = syncing.read_time_maps(calibration, found)
    refused = {**refused, **reasons}
    unknown = [film.path.name for name, film in found.items() if name not in known]
    why_not = [refused.get(name, f"{name} is not in the calibration") for name in found if name not in known]
    warnings += [f"{file}: {why}; left out" for file, why in zip(unknown, why_not, strict=True)]
    used = [video for video in listed if video.camera in known and video.camera in found]
    if not used:
        names = ", ".join(known)
        raise InputError(f"no video is named after a camera ({names})", file=folder, remedy="rename the videos")
    films = {video.camera: found[video.camera] for video in used}
    maps = {name: known[name] for name in films}
    spans = {name: syncing.reference_span(film, maps[name]) for name, film in films.items()}
    rate = fps or max(film.info.fps for film in films.values())
    grid = syncing.common_time_grid(spans, rate)
    done: dict[str, syncing.SynchronisedVideo] = {}
    total = sum(max(film.info.frames, 1) for film in films.values())
    before = 0
    with progress_bar("synchronising", quiet=json) as progress:
        for name, film in films.items():

            def report(frame: int, name: str = name, before: int = before) -> None:
                progress(f"{name} frame {frame}", min((before + frame) / total, 1.0))

            target = file_in(out, f"{name}.mp4")
            if videos == "trim":
                span = syncing.Span(max(s.first for s in spans.values()), min(s.last for s in spans.values()))
                done[name] = syncing.trim(film, maps[name], span, target, report)
            else:
                target_or_none = target if videos == "retime" else None
                done[name] = syncing.retime(film, maps[name], grid, target_or_none, rate, report)
            before += film.info.frames
            warnings += [f"{film.path.name}: {text}" for text in film.warnings]
    files = {file_in(out, f"{name}.csv"): syncing.times_text(video) for name, video in done.items()}
    if videos != "trim":
        files[out / syncing.GRID] = syncing.grid_text(grid, done, csv_cell)
    earlier, kept = syncing.earlier_results(out, {*files, *(out / f"{name}.mp4" for name in done if videos != "none")})
    remove_files(earlier)
    warnings += [f"{file} is of an earlier run" for file in kept]
    write_together(files)
    written = [str(file) for file in files]
    if videos != "none":
        written += [str(out / f"{name}.mp4") for name in done]
    document = {
        "out": str(out),
        "files": written,
        "reference": reference,
        "fps": rate,
        "begin": float(grid[0]),
        "end": float(grid[-1]),
        "frames": {name: len(video.source_frames) for name, video in done.items()},
        "largest_error_s": {name: float(abs(video.error).max(initial=0.0)) for name, video in done.items()},
        "time_offset_std": {name: stds[name] for name in done},
        "warnings": warnings,
    }
    lines = [f"common span: {grid[0]:.3f} to {grid[-1]:.3f} s of the reference clock, {grid[-1] - grid[0]:.3f} s"]
    for name, video in done.items():
        at = 0.5 * (video.time[0] + video.time[-1])
        lag = known[name].clock_rate * at + known[name].time_offset - at
        std = f" ± {1e3 * known_std:.3f} ms" if (known_std := stds[name]) else ""
        text = f"{name}: {len(video.time)} frames, clock {lag:+.4f} s{std} against {reference}"
        if videos == "retime":
            middle, worst = 1e3 * float(abs(video.error).mean()), 1e3 * float(abs(video.error).max())
            text += f"; frames shown up to {worst:.1f} ms (mean {middle:.1f}) from the grid"
        lines.append(text)
    return answer(document, [*lines, *closing_lines(warnings, written)], json)


def _estimate(folder: Path, out: Path, quiet: bool) -> tuple[Path, dict[str, str]]:
    """Calibrate the videos as far as they allow; the file with their clocks, and why others have none, by camera.

    Raises Refused where none is known.
    """
    from deploy.offline.video_folder import SESSION, session_from_videos
    from hub.api import CALIBRATION, RESULT, calibrate, save_refusal
    from hub.clocks.sound import sound_pairs

    with progress_bar(f"looking for what moves in {folder.name}", quiet=quiet) as progress:
        session = session_from_videos(folder, out / SESSION, progress, detector="auto")
    for line in () if quiet else session.summaries:
        print(line)
    try:
        if session.refusal is not None:
            raise session.refusal
        with progress_bar("estimating the lags", quiet=quiet) as progress:
            result = calibrate(session, progress=progress)
        result.save(out)
    except Refused as refusal:
        refusal.pairs += sound_pairs(session.clock_priors, refusal.pairs)
        save_refusal(out, refusal, session)
        if not any(pair.lag_s is not None for pair in refusal.pairs):
            if refusal.pairs:  # poses and lenses, which the refusal may be about, are not asked for here
                every = "; ".join(f"{' and '.join(pair.cameras)}: {pair.status}" for pair in refusal.pairs)
                refusal.reason = f"the lag of no pair of these videos is known ({every})"
            raise
        return out / RESULT, _unknown_lags(refusal.pairs)
    return out / CALIBRATION, _unknown_lags(result.calibration.pairs)


def _unknown_lags(pairs: Iterable[PairReport]) -> dict[str, str]:
    """Why a camera is in no pair with a lag, by camera; lenses and poses, which a lag does not need, are left aside."""
    pairs = list(pairs)
    timed = {name for pair in pairs if pair.lag_s is not None for name in pair.cameras}
    tried: dict[str, list[str]] = {}
    for pair in pairs:
        for name, other in (pair.cameras, pair.cameras[::-1]):
            tried.setdefault(name, []).append(f"with {other}: {pair.status}")
    return {name: f"its lag is not known ({'; '.join(all_)})" for name, all_ in tried.items() if name not in timed}
