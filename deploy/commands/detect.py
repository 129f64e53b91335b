"""`syncline detect`: one detector over one video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from deploy.progress import progress_bar
from protocols.errors import EXIT_DONE, InputError, Refused


def detect(
    what: Literal["marker", "person", "vehicle"],
    video: Path,
    /,
    *,
    out: Path,
    camera: str | None = None,
    teach: Annotated[bool, Parameter(negative="")] = False,
    target: str | None = None,
    start: int = 0,
    marker: Path | None = None,
    colour: str | None = None,
    rig: Path | None = None,
    fps: float | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Find one thing in every frame of a video, and write when and where it was seen.

    Writes camera,frame,time,u,v,size,label,score to --out: time as the file says (variable frame rates are kept),
    u, v and size in pixels. Exit status 3 if it is in no frame.

    Example: syncline detect marker cam0.mp4 --out observations.csv

    Example: syncline detect marker cam0.mp4 --teach --target 612,300,40,40 --out observations.csv

    Parameters
    ----------
    what
        marker: one brightly coloured ball. person, vehicle: not in this version.
    video
        A video file, or a folder of pictures in the order of their names.
    out
        The CSV file to write.
    camera
        The camera's name in it; default: the video's name.
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
    json
        Print a summary as JSON.
    seed
        Accepted as everywhere; nothing here is drawn at random.
    """
    if what != "marker":
        raise InputError(f"`detect {what}` is not in this version", remedy="use `detect marker`")
    if fps is not None and not 0.1 <= fps <= 10_000:
        raise InputError(f"--fps {fps:g} is out of range", remedy="give frames a second")
    if out.is_dir():
        raise InputError("a folder of this name is in the way", file=out, remedy="give --out the name of a CSV file")
    if teach != (target is not None):
        remedy = "give --teach --target x,y,w,h: the box of the marker in frame --start"
        raise InputError("--teach and --target go together", remedy=remedy)
    if sum((teach, marker is not None, colour is not None)) > 1:
        raise InputError("--teach, --marker and --colour each say what the marker looks like", remedy="keep one")
    from deploy import detecting
    from deploy.track import choose_camera, parse_target
    from edge.detectors.marker import MarkerModel
    from edge.devices.base import check_size
    from edge.devices.film import Film
    from protocols.files import write_together

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
    with progress_bar(f"looking through {video.name}", quiet=json) as tell:
        total = film.info.frames

        def told(frame: int) -> None:
            tell(f"frame {frame}" + (f" of {total}" if total else ""), frame / total if total else 0.0)

        found = detecting.detect_in(film, name, detecting.marker_detector(model, lens, film.info.size), told)
    if not found.rows:
        raise Refused(
            f"{video}: no marker in any of {found.frames} frames; use a brightly coloured ball that is whole in the "
            "picture, or show it with --teach --target x,y,w,h"
        )
    write_together({**files, out: detecting.observations_text(found.rows)})
    warnings = [f"{video}: {warning}" for warning in found.warnings]
    if json:
        import json as json_module

        document = {
            "out": str(out),
            "files": [str(file) for file in (*files, out)],
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
    print(f"{name}: seen in {found.seen} of {found.frames} frames, {found.fps:.3f} frames a second")
    for warning in warnings:
        print(f"warning: {warning}")
    print(f"written: {', '.join(str(file) for file in (out, *files))}")
    return EXIT_DONE


def _colour(text: str) -> tuple[int, int, int]:
    remedy = "give --colour red,green,blue, each from 0 to 255, as in 246,112,22"
    try:
        red, green, blue = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--colour {text!r} is not three whole numbers", remedy=remedy) from None
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise InputError(f"--colour {text!r} is beyond 0 to 255", remedy=remedy)
    return red, green, blue
