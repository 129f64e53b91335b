"""`syncline detect`: detections of a marker, people or vehicles in a video, as observations.csv."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from deploy.commands.common import (
    Flag,
    Json,
    NumberList,
    Scheduler,
    UnusedSeed,
    answer,
    check_file,
    check_range,
    check_rate,
    closing_lines,
    parse_box,
    refuse,
)
from deploy.offline.progress import progress_bar
from protocols.core.errors import InputError, Refused
from protocols.core.names import check_name, name_from_file

_REMEDIES = {
    "marker": "use a brightly coloured ball that is whole in the picture, or show it with --teach --target x,y,w,h",
    "bright": "a shorter exposure in a darker room, or a lower --threshold",
    "tag": "give the tags' family with --dictionary, and keep a white margin round them",
    "person": "nobody was seen moving before a fixed camera",
    "vehicle": "nothing was seen moving",
}


def detect(
    what: Literal["marker", "person", "vehicle"],
    video: Path,
    /,
    *,
    out: Path,
    camera: str | None = None,
    mode: Literal["colour", "bright", "tag"] = "colour",
    threshold: int | None = None,
    dictionary: str | None = None,
    teach: Flag = False,
    target: NumberList | None = None,
    start: int = 0,
    marker: Path | None = None,
    colour: str | None = None,
    rig: Path | None = None,
    fps: float | None = None,
    overlay: Path | None = None,
    background: Literal["mog2", "knn"] = "mog2",
    detector: str | None = None,
    json: Json = False,
    scheduler: Scheduler = None,
    seed: UnusedSeed = 0,
) -> int:
    """Detect a marker, people or vehicles in every frame of a video, and write the times and pixels.

    Writes camera,frame,time,u,v,size,label,score,kind,cov_uu,cov_uv,cov_vv,head_u,head_v,foot_u,foot_v and
    box_x,box_y,box_w,box_h (x, y of the top left) to --out: time is the file's presentation time (variable frame rates
    are kept), all others are in pixels; an empty cell is not measured. Exit status 3 if nothing is detected in any
    frame.

    People and vehicles are detected as motion before the background, or by --detector. person: u, v is the
    representative point, size the distance from head to foot; label p0, p1, ... is one per track in this video (person
    where there is never more than one). vehicle: u, v is the box's centre; label t0, t1, ... is one per track; the
    camera may be moving.

    Example: syncline detect marker cam0.mp4 --out observations.csv

    Example: syncline detect marker cam0.mp4 --teach --target 612,300,40,40 --out observations.csv

    Example: syncline detect marker cam0.mp4 --mode tag --out observations.csv

    Example: syncline detect person street.mp4 --out observations.csv --overlay seen.mp4

    Example: syncline detect person street.mp4 --detector yolo.toml --out observations.csv

    Parameters
    ----------
    what
        marker: one brightly coloured ball. person: before a fixed camera. vehicle: moving ones.
    video
        A video file, or a folder of pictures in the order of their names.
    out
        The CSV file to write.
    camera
        The camera's name in it; default: the video's name.
    mode
        Kind of marker. colour: a ball. bright: an LED, or a retro-reflector beside the camera's lamp, in an otherwise
        darker picture. tag: AprilTags or ArUco tags, each labelled by its number: tag7; u, v is the tag's centre, size
        its side as seen face on.
    threshold
        Grey level from 30 to 254 that a bright marker exceeds; 200 by default.
    dictionary
        Family of the tags: apriltag_36h11 by default, apriltag_16h5, 4x4_50, 5x5_100, 6x6_250, ...
    teach
        Learn the marker's colour from --target first, and write it to marker.toml beside --out.
    target
        The marker's box in frame --start, x,y,w,h in pixels; x,y is its top left.
    start
        Index of that frame; 0 is the first.
    marker
        A marker.toml that --teach wrote. Default: the orange ball of the demo.
    colour
        The marker's colour in place of that file, red,green,blue from 0 to 255.
    rig
        A rig.toml with this camera's matrix: a large ball's centre is then corrected for perspective.
    fps
        Frame rate [Hz] in place of the file's time stamps; 30 by default for a folder of pictures.
    overlay
        A video to write: a copy with the detections drawn into it.
    background
        OpenCV's background model for people and vehicles: mog2 or knn.
    detector
        For people and vehicles: the .toml file of an ONNX network, or the name of a detector that another package
        registers, in place of the shipped one.
    """
    shown = {"--teach": teach or None, "--target": target, "--marker": marker, "--colour": colour, "--rig": rig}
    if what != "marker":
        refuse(shown, f"`detect {what}`")
    _check_mode(what, mode, shown, threshold, dictionary)
    if detector is not None and (what == "marker" or background != "mog2"):
        other = "`detect marker`" if what == "marker" else "--background"
        raise InputError(f"--detector cannot be used with {other}", remedy="leave one of them out")
    check_rate(fps)
    check_file(out, "a CSV file", video, marker, rig)
    if overlay is not None:
        check_file(overlay, "a video", video, out, option="--overlay")
    if teach != (target is not None):
        remedy = "give --teach --target x,y,w,h: the box of the marker in frame --start"
        raise InputError("--teach and --target go together", remedy=remedy)
    if sum((teach, marker is not None, colour is not None)) > 1:
        raise InputError("--teach, --marker and --colour each say what the marker looks like", remedy="keep one")
    from deploy.offline.track import choose_camera
    from edge.detectors.marker.ball import MarkerModel
    from edge.devices.playback.video_reader import VideoReader
    from edge.offline.video import MARKER_FILE, detect_video, learn_marker_from_frame, marker_toml
    from protocols.core.files import write_together

    name = name_from_file(video.stem, video) if camera is None else check_name(camera, "--camera")
    files: dict[Path, str] = {}
    model: MarkerModel | Path | None = marker
    if target is not None:
        model = learn_marker_from_frame(VideoReader(video, fps), parse_box(target), start)
        files[out.parent / MARKER_FILE] = marker_toml(model)
    elif colour is not None:
        model = MarkerModel.of_colour(*_colour(colour))
    with progress_bar(f"looking through {video.name}", quiet=json) as progress:
        found = detect_video(
            video,
            detector or (mode if mode != "colour" else what),
            kind=None if detector is None or what == "marker" else what,
            camera=name,
            marker=model,
            intrinsics=None if rig is None else choose_camera(rig, Path(f"{name}.mp4")).intrinsics,
            fps=fps,
            threshold=threshold or 200,
            dictionary=dictionary or "apriltag_36h11",
            background=background,
            overlay=overlay,
            progress=progress,
        )
    if not found.rows:
        remedy = (
            "a lower `score` in its file may find more, if its `layout`, `classes`, `box` and `pixels` are the model's"
            if detector
            else _REMEDIES[mode if mode in _REMEDIES else what]
        )
        raise Refused("; ".join((f"{video}: no {what} in any of {found.frames} frames", *found.warnings, remedy)))
    write_together({**files, out: found.to_csv()})
    warnings = [f"{video}: {warning}" for warning in found.warnings]
    document = {
        "out": str(out),
        "files": [str(file) for file in (*files, out, *([overlay] if overlay else []))],
        "labels": sorted({row.split(",")[6] for row in found.rows}),
        "camera": name,
        "size": list(found.size),
        "fps": found.fps,
        "frames": found.frames,
        "frames_with_detection": found.frames_with_detection,
        "corrupt": found.corrupt,
        "repaired": found.repaired,
        "warnings": warnings,
    }
    frames = f"{found.frames_with_detection} of {found.frames} frames"
    written = [out, *files, *([overlay] if overlay else [])]
    lines = [f"{name}: seen in {frames}, {found.fps:.3f} frames a second", *closing_lines(warnings, written)]
    return answer(document, lines, json)


def _check_mode(
    what: str, mode: str, shown: Mapping[str, object], threshold: int | None, dictionary: str | None
) -> None:
    """Check that the options fit together. Raises InputError."""
    if mode != "colour":
        refuse({"--mode": None if what == "marker" else mode}, f"`detect {what}`")
        refuse(shown, f"a marker of --mode {mode}")
    for option, value, owner in (("--threshold", threshold, "bright"), ("--dictionary", dictionary, "tag")):
        if value is not None and mode != owner:
            raise InputError(f"{option} belongs to --mode {owner}", remedy=f"add --mode {owner}, or leave it out")
    check_range("--threshold", threshold, 30, 254, "give a grey level from 30 to 254")


def _colour(text: str) -> tuple[int, int, int]:
    remedy = "give --colour red,green,blue, each from 0 to 255, as in 246,112,22"
    try:
        red, green, blue = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--colour {text!r} is not three whole numbers", remedy=remedy) from None
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise InputError(f"--colour {text!r} is beyond 0 to 255", remedy=remedy)
    return red, green, blue
