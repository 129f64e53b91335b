"""`syncline import`: converts other tools' calibrations and tracks, and session folders, to Syncline's own files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from deploy.commands.common import Json, answer, check_file, check_range, check_rate, closing_lines, parse_size
from protocols.core.errors import InputError
from protocols.core.ranges import MAX_IMAGE_SIDE

Format = Literal[
    "aniposelib", "caliscope", "pose2sim", "freemocap", "opencv", "kalibr", "colmap", "opensfm", "qualisys", "vicon",
    "optitrack", "caliscope-points", "deeplabcut", "mvus", "openpose", "mmpose", "coco", "mediapipe", "sleap",
    "deeplabcut-h5", "freemocap-points", "session",
]  # fmt: skip


def import_(
    *sources: Path,
    out: Path,
    format: Format | None = None,
    units: Literal["m", "cm", "mm"] | None = None,
    fps: float | None = None,
    videos: Path | None = None,
    size: str | None = None,
    likelihood: float = 0.6,
    camera: str | None = None,
    calibration: Path | None = None,
    arrival_delay_ms: float = 0.0,
    arrival_jitter_ms: float = 0.0,
    json: Json = False,
    seed: int = 0,
) -> int:
    """Convert another tool's calibration or 2-D tracks, or a session folder.

    Calibrations (aniposelib, caliscope, Pose2Sim, FreeMoCap, OpenCV YAML, Kalibr camchain, ROS camera_info, COLMAP
    text, OpenSfM; XML of Qualisys, Vicon and OptiTrack) become a rig.toml, which also serves as a calibration.toml if
    it has all poses.
    Tracks (caliscope CSV, DeepLabCut CSV, mvus text) and keypoints of people or animals (OpenPose, RTMPose, MMPose and
    Pose2Sim JSON folders, DeepLabCut and SLEAP HDF5, FreeMoCap npy, COCO and MediaPipe JSON) become an observations.csv
    with a label a joint, and a session folder becomes a .mcap log. The format is detected from the content.
    A folder with detections of people (boxes.csv, or observations.csv as `detect person` writes it) needs no rig.toml
    where --calibration gives the cameras.

    Example: syncline import camchain.yaml --out rig.toml

    Example: syncline import cam0DLC_resnet50.csv cam1DLC_resnet50.csv --videos my-videos --out observations.csv

    Example: syncline import my-project/pose --videos my-project/videos --out my-session/observations.csv

    Example: syncline import my-session --out my-session.mcap

    Example: syncline import my-session --calibration out/calibration.toml --arrival-delay-ms 50 --out live.mcap

    Parameters
    ----------
    sources
        Files, one per camera if the format requires it, or a folder of them.
    out
        The rig.toml, observations.csv or .mcap to write.
    format
        Format of the sources, if it cannot be detected from the content.
    units
        Length unit of a calibration, instead of the format's own.
    fps
        Frame rate in Hz, for tracks with frame numbers only.
    videos
        Folder of the tracked videos, each named after its camera: frame times are read from them (variable frame
        rates), and image sizes: a rig.toml is written beside the observations where there is none.
    size
        Image size of all cameras, as 1920x1080, where there are no videos.
    likelihood
        Points with a smaller likelihood (confidence, score) are discarded.
    camera
        The camera's name, for tracks in one file; default: the file's name.
    calibration
        For a session: the calibration.toml that gives its clocks. The log then holds the frames of all cameras in the
        order in which they were exposed, and `replay` plays them as they happened. Default: all cameras start together.
    arrival_delay_ms
        With --calibration: from a frame's exposure to its arrival in the log.
    arrival_jitter_ms
        With --calibration: standard deviation of a normal distribution, whose magnitude is added to each delay. A
        camera's frames keep their order.
    seed
        Seed of the jitter.
    """
    if not sources:
        raise InputError("nothing to import", remedy="give files, or a folder")
    check_file(out, "a file", *sources, calibration)
    check_rate(fps)
    check_range("--likelihood", likelihood, 0.0, 1.0)
    if fps is not None and videos is not None:
        raise InputError("--fps and --videos each give the frames' times", remedy="keep one")
    if calibration is None and (arrival_delay_ms or arrival_jitter_ms):
        raise InputError("arrival times need the cameras' clocks", remedy="give --calibration CALIB.toml")
    for option, value in (("--arrival-delay-ms", arrival_delay_ms), ("--arrival-jitter-ms", arrival_jitter_ms)):
        check_range(option, value, 0.0, 1e6, "give milliseconds, 0 or more")
    from deploy.offline.exchange import imports, session_log
    from protocols.core.files import write_atomically
    from protocols.session.folder import read_folder, write_observations
    from protocols.session.rig import read_rig

    source = imports.detect_source(list(sources), format)
    _check_suffix(source.kind, out)
    if calibration is not None and source.kind != "session":
        raise InputError("--calibration goes with a session folder", remedy="leave it out")
    warnings: tuple[str, ...] = ()
    if source.kind == "session":
        folder, arrivals = source.files[0], None
        objects = session_log.objects_file(folder) is not None
        session = None if objects else read_folder(folder)
        if calibration is not None:
            timed_rig = read_rig(calibration) if session is None else session[0]
            delay, jitter = 1e-3 * arrival_delay_ms, 1e-3 * arrival_jitter_ms
            arrivals = session_log.read_arrivals(calibration, timed_rig, delay, jitter, seed)
        if session is None:
            rig, rows, count = session_log.objects_to_log(folder, calibration, out, arrivals)
        else:
            rig, seen = session
            rows, count, warnings = len(seen), session_log.session_to_log(rig, seen, out, arrivals), seen.warnings
            if rig.scale_bars:
                warnings += ("a log does not store the scale bar: add it to the rig.toml of its export",)
            if rig.bodies:
                warnings += ("a log does not store the board: its corners are single points there",)
        noun = "detections" if objects else "observations"
        summary = f"{len(rig.cameras)} cameras, {rows} {noun}, {count} messages"
        cameras = list(rig.cameras)
    elif source.kind in imports.POINTS:
        remedy = "give width x height in pixels: 1920x1080"
        wanted = None if size is None else parse_size("--size", size, remedy, 1, MAX_IMAGE_SIDE)
        tables = imports.camera_tables(videos, wanted, fps)
        seen = imports.read_points(source, imports.frame_clock(fps, videos), likelihood, camera, tables)
        write_observations(out, seen)
        imports.write_missing_rig(out.parent, seen.cameras, tables)
        warnings = seen.warnings
        summary = f"{len(seen)} observations of {len(seen.labels)} points by {', '.join(seen.cameras)}"
        cameras = seen.cameras
    else:
        foreign = imports.read_foreign_calibration(source)
        write_atomically(out, imports.calibration_text(foreign, units, source.files[0]))
        posed = sum(one.pose is not None for one in foreign.cameras.values())
        timed = sum(one.time_map is not None for one in foreign.cameras.values())
        warnings = foreign.warnings
        if units is None and foreign.units is None and posed:
            warnings += ("the file states no units: its lengths are taken as metres (--units)",)
        summary = (
            f"{len(foreign.cameras)} cameras ({', '.join(foreign.cameras)}), {posed} with poses, {timed} with clocks"
        )
        cameras = list(foreign.cameras)
    document = {"out": str(out), "format": source.kind, "cameras": cameras, "warnings": list(warnings)}
    return answer(document, [f"{source.kind}: {summary}", *closing_lines(warnings, [out])], json)


def _check_suffix(kind: str, out: Path) -> None:
    """Raise InputError if the suffix of ``out`` does not fit its content: it could not be read back."""
    from deploy.offline.exchange.imports import POINTS

    wanted = ".mcap" if kind == "session" else ".csv" if kind in POINTS else ".toml"
    if out.suffix.lower() != wanted:
        raise InputError(f"{kind} becomes a {wanted} file", file=out, remedy=f"give --out a name that ends in {wanted}")
