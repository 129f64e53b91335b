"""`syncline detect`: one detector over one video."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from deploy.offline.progress import progress_bar
from edge.detectors.base import Detection, Detector
from protocols.core.errors import EXIT_DONE, InputError, Refused

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
    teach: Annotated[bool, Parameter(negative="")] = False,
    target: str | None = None,
    start: int = 0,
    marker: Path | None = None,
    colour: str | None = None,
    rig: Path | None = None,
    fps: float | None = None,
    overlay: Path | None = None,
    background: Literal["mog2", "knn"] = "mog2",
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Find a marker, people or vehicles in every frame of a video, and write when and where they were seen.

    Writes camera,frame,time,u,v,size,label,score to --out: time as the file says (variable frame rates are kept),
    u, v and size in pixels. Exit status 3 if nothing is in any frame.

    People and vehicles are what moves before the background; person: u, v is the representative point, size the
    distance from head to foot, label p0, p1, ... one a person as far as this video tells (person where there is never
    more than one). vehicle: u, v is the box's centre, label t0, t1, ... one a vehicle; the camera may be moving. Both
    have further columns: head_u,head_v,foot_u,foot_v,box_x,box_y,box_w,box_h (x, y of the top left).

    Example: syncline detect marker cam0.mp4 --out observations.csv

    Example: syncline detect marker cam0.mp4 --teach --target 612,300,40,40 --out observations.csv

    Example: syncline detect marker cam0.mp4 --mode tag --out observations.csv

    Example: syncline detect person street.mp4 --out observations.csv --overlay seen.mp4

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
        Of a marker. colour: a ball. bright: an LED, or a retro-reflector beside the camera's lamp, in a picture that is
        darker otherwise. tag: AprilTags or ArUco tags, each labelled by its number: tag7; u, v is the tag's centre,
        size the side that it would have seen straight on.
    threshold
        Grey level from 30 to 254 that a bright marker exceeds; 200 by default.
    dictionary
        Family of the tags: apriltag_36h11 by default, apriltag_16h5, 4x4_50, 5x5_100, 6x6_250, ...
    teach
        Learn the marker's colour from --target first, and keep it as marker.toml beside --out.
    target
        The marker's box in frame --start, x,y,w,h in pixels; x,y is its top left.
    start
        Index of that frame; 0 is the first.
    marker
        A marker.toml that --teach wrote. Default: the orange ball of the demo.
    colour
        The marker's colour instead, red,green,blue from 0 to 255.
    rig
        A rig.toml with this camera's matrix: a large ball's centre is then corrected for perspective.
    fps
        Frame rate, instead of the file's time stamps; of pictures 30 by default.
    overlay
        A video to write, with what was found drawn into it.
    background
        Model of the background for people and vehicles: mog2 or knn.
    json
        Print a summary as JSON.
    seed
        Accepted as everywhere; nothing here is drawn at random.
    """
    shown = {"--teach": teach or None, "--target": target, "--marker": marker, "--colour": colour, "--rig": rig}
    if what != "marker" and (useless := [option for option, value in shown.items() if value is not None]):
        raise InputError(f"{useless[0]} means nothing for `detect {what}`", remedy="leave it out")
    _check_mode(what, mode, shown, threshold, dictionary)
    if fps is not None and not 0.1 <= fps <= 10_000:
        raise InputError(f"--fps {fps:g} is out of range", remedy="give frames a second")
    if out.is_dir():
        raise InputError("a folder of this name is in the way", file=out, remedy="give --out the name of a CSV file")
    if overlay is not None and (overlay.is_dir() or not overlay.parent.is_dir()):
        raise InputError("cannot be written", file=overlay, remedy="give --overlay a file in a folder that exists")
    if teach != (target is not None):
        remedy = "give --teach --target x,y,w,h: the box of the marker in frame --start"
        raise InputError("--teach and --target go together", remedy=remedy)
    if sum((teach, marker is not None, colour is not None)) > 1:
        raise InputError("--teach, --marker and --colour each say what the marker looks like", remedy="keep one")
    from deploy.offline import detect as detecting
    from deploy.offline.track import choose_camera, parse_target
    from edge.detectors.marker.ball import MarkerModel
    from edge.devices.base import check_size
    from edge.devices.playback.video_reader import Film
    from protocols.core.files import write_together

    film = Film(video, fps)
    name = video.stem if camera is None else camera
    if not name or name != name.strip() or '"' in name or name == "metadata":
        raise InputError(f"{name!r} is no name for a camera", remedy="give --camera letters, digits, - and _")
    lens = choose_camera(rig, Path(f"{name}.mp4")).intrinsics if rig is not None else None
    check_size(lens, *film.info.size, str(video))
    files: dict[Path, str] = {}
    model = MarkerModel.default()
    if target is not None:
        box = parse_target(target)
        model = detecting.teach_from(film, (box.x, box.y, box.width, box.height), start)
        files[out.parent / detecting.MARKER_FILE] = detecting.marker_text(model)
    elif marker is not None:
        model = detecting.read_marker(marker)
    elif colour is not None:
        model = MarkerModel.of_colour(*_colour(colour))
    extra = ""
    with progress_bar(f"looking through {video.name}", quiet=json) as tell:
        total = film.info.frames

        def told(frame: int) -> None:
            tell(f"frame {frame}" + (f" of {total}" if total else ""), frame / total if total else 0.0)

        if what == "marker":
            detector: Detector = (
                detecting.marker_detector(model, lens, film.info.size)
                if mode == "colour"
                else detecting.other_marker(mode, threshold or 200, dictionary or "apriltag_36h11")
            )
            drawn: dict[int, list[tuple[str, Detection]]] = {}
            found = detecting.detect_in(film, name, detector, told, seen=drawn if overlay else None)
            if overlay is not None:
                found = detecting.with_overlay(film, found, drawn, overlay)
        else:
            from deploy.offline import detect_moving

            extra = detect_moving.HEADER_EXTRA
            moving = detect_moving.make_detector(what, background, film.info.fps)
            found = detect_moving.find_moving(film, name, moving, tell, overlay)
    if not found.rows:
        raise Refused(
            f"{video}: no {what} in any of {found.frames} frames; {_REMEDIES[mode if mode in _REMEDIES else what]}"
        )
    write_together({**files, out: detecting.observations_text(found.rows, extra)})
    warnings = [f"{video}: {warning}" for warning in found.warnings]
    if json:
        import json as json_module

        document = {
            "out": str(out),
            "files": [str(file) for file in (*files, out, *([overlay] if overlay else []))],
            "labels": sorted({row.split(",")[6] for row in found.rows}),
            "camera": name,
            "size": list(found.size),
            "fps": found.fps,
            "frames": found.frames,
            "frames_with_detection": found.seen,
            "corrupt": found.corrupt,
            "repaired": found.repaired,
            "warnings": warnings,
        }
        print(json_module.dumps(document, allow_nan=False))
        return EXIT_DONE
    if overlay is not None:
        files[overlay] = ""
    print(f"{name}: seen in {found.seen} of {found.frames} frames, {found.fps:.3f} frames a second")
    for warning in warnings:
        print(f"warning: {warning}")
    print(f"written: {', '.join(str(file) for file in (out, *files))}")
    return EXIT_DONE


def _check_mode(
    what: str, mode: str, shown: Mapping[str, object], threshold: int | None, dictionary: str | None
) -> None:
    """Raise InputError for options that mean nothing together."""
    if mode != "colour" and what != "marker":
        raise InputError(f"--mode means nothing for `detect {what}`", remedy="leave it out")
    if mode != "colour" and (useless := [option for option, value in shown.items() if value is not None]):
        raise InputError(f"{useless[0]} means nothing for a marker of --mode {mode}", remedy="leave it out")
    for option, value, owner in (("--threshold", threshold, "bright"), ("--dictionary", dictionary, "tag")):
        if value is not None and mode != owner:
            raise InputError(f"{option} belongs to --mode {owner}", remedy=f"add --mode {owner}, or leave it out")
    if threshold is not None and not 30 <= threshold <= 254:
        raise InputError(f"--threshold {threshold} is out of range", remedy="give a grey level from 30 to 254")


def _colour(text: str) -> tuple[int, int, int]:
    remedy = "give --colour red,green,blue, each from 0 to 255, as in 246,112,22"
    try:
        red, green, blue = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--colour {text!r} is not three whole numbers", remedy=remedy) from None
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise InputError(f"--colour {text!r} is beyond 0 to 255", remedy=remedy)
    return red, green, blue
