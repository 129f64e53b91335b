"""Detection in a whole video by any detector, and marker model files."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import tomli_w

from edge.detectors.base import Detector, Kind
from edge.detectors.marker.ball import MarkerModel, learn_marker_model
from edge.detectors.marker.factory import ball_detector, bright_or_tag_detector
from edge.detectors.moving.foreground import SubtractorName
from edge.detectors.plugins import is_plugin, load_detector, unknown_detector
from edge.devices.base import check_size
from edge.devices.playback.video_reader import VideoReader
from edge.offline.detections import Collected, VideoDetections, run_detector
from protocols.core.errors import InputError
from protocols.core.files import read_toml
from protocols.core.names import check_name, name_from_file
from protocols.geometry.camera import Intrinsics

VideoDetector = Literal["marker", "bright", "tag", "person", "vehicle"]
MARKER_FILE = "marker.toml"
"""File of the marker model beside the videos, where `calibrate` looks for it."""


def detect_video(
    video: str | Path,
    detector: VideoDetector | str | Path = "marker",
    *,
    kind: Kind | None = None,
    camera: str | None = None,
    marker: MarkerModel | str | Path | None = None,
    intrinsics: Intrinsics | None = None,
    fps: float | None = None,
    threshold: int = 200,
    dictionary: str = "apriltag_36h11",
    background: Literal["mog2", "knn"] = "mog2",
    overlay: str | Path | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> VideoDetections:
    """Detect a marker, people or vehicles in every frame of a video file or of a folder of images.

    Parameters
    ----------
    video
        A video file, or a folder of images in the order of their names.
    detector
        marker: one brightly coloured ball. bright: a point of light. tag: AprilTag or ArUco tags. person: people
        before a fixed camera. vehicle: moving vehicles; the camera may move. Or a network's .toml file, or another
        package's detector by name: see ``edge.detectors.plugins.load_detector``.
    kind
        Of such a network or package: keep only people or only vehicles; default: all.
    camera
        Name of the camera in the rows; default: the video's name.
    marker
        Of ``marker``: the ball's appearance, or the file marker.toml; default: the orange ball of the demo.
    intrinsics
        Of ``marker``: the camera's intrinsics for this image size. The ball's centre is then corrected for perspective
        and distortion.
    fps
        Frame rate [Hz] in place of the file's time stamps; default of image folders: 30.
    threshold
        Of ``bright``: grey level (0..255) that the point of light exceeds.
    dictionary
        Of ``tag``: family of the tags, see ``edge.detectors.marker.tag.DICTIONARIES``.
    background
        Of ``person`` and ``vehicle``: OpenCV's background model.
    overlay
        Video file to write, a copy with the detections drawn into it.
    progress
        Called now and then with a text and the fraction (0..1) of the frames done.

    Returns
    -------
    VideoDetections
        Pixels are distorted ones, (0, 0) is the centre of the top-left pixel; times are those of the file [s]. There
        are no rows where nothing was detected.

    Raises
    ------
    InputError
        Where the video or the marker file cannot be read, or intrinsics are for another image size.
    """
    path, move = Path(video), progress or (lambda text, fraction: None)
    detector = str(detector)
    shipped = detector in (names := get_args(VideoDetector))
    if not shipped and not is_plugin(detector):
        raise unknown_detector(detector, names)
    if kind is not None and shipped:
        raise InputError(f"kind has no effect on the detector {detector}", remedy="leave it out")
    if detector != "marker" and (marker is not None or intrinsics is not None):
        given = "intrinsics" if marker is None else "marker"
        raise InputError(f"{given} has no effect on the detector {detector}", remedy="leave it out")
    reader = VideoReader(path, fps)
    name = name_from_file(path.stem, path) if camera is None else check_name(camera, "camera")
    check_size(intrinsics, *reader.info.size, str(path))
    overlay = None if overlay is None else Path(overlay)
    if not shipped or detector in get_args(Kind):
        return detect_objects(reader, name, detector, kind, background, move, overlay)
    on_frame = _frame_progress(reader, move)
    if detector == "marker":
        model = read_marker_model(Path(marker)) if isinstance(marker, str | Path) else marker or MarkerModel.default()
        finder: Detector = ball_detector(model, intrinsics, reader.info.size)
    else:
        finder = bright_or_tag_detector("tag" if detector == "tag" else "bright", threshold, dictionary)
    drawn: Collected = {}
    found = run_detector(reader, name, finder, on_frame, collected=None if overlay is None else drawn)
    if overlay is None:
        return found
    from edge.offline.moving import named_detections

    labels = {one.label: one.label for _, seen in drawn.values() for one in seen}
    return named_detections(reader, name, found, drawn, labels, overlay)


def detect_objects(
    video: VideoReader,
    camera: str,
    detector: str,
    kind: Kind | None,
    background: SubtractorName,
    progress: Callable[[str, float], None],
    overlay: Path | None = None,
) -> VideoDetections:
    """Detect people, vehicles, or what a network or another package's detector finds; arguments as ``detect_video``'s.

    Where a network never finds more than one person, or one vehicle, at a time, all of them are one label, ``person``
    or ``vehicle``, although its track was lost in between. Raises InputError.
    """
    from edge.offline.moving import detect_moving, moving_detector, named_detections

    fps = video.info.fps
    if detector in get_args(Kind):
        return detect_moving(video, camera, moving_detector(detector, background, fps), progress, overlay)
    seen: Collected = {}
    other = load_detector(detector, kind=kind, fps=fps)
    found = run_detector(video, camera, other, _frame_progress(video, progress), collected=seen)
    several = {one.kind for _, shown in seen.values() for one in shown if sum(one.kind == k.kind for k in shown) > 1}
    names = {
        one.label: one.label if one.kind in several or one.kind not in get_args(Kind) else one.kind
        for _, shown in seen.values()
        for one in shown
    }
    return named_detections(video, camera, found, seen, names, overlay)


def _frame_progress(video: VideoReader, progress: Callable[[str, float], None]) -> Callable[[int], None]:
    total = video.info.frames

    def on_frame(frame: int) -> None:
        progress(f"frame {frame}" + (f" of {total}" if total else ""), min(frame / total, 1.0) if total else 0.0)

    return on_frame


def read_marker_model(file: Path) -> MarkerModel:
    """Read the marker model that ``detect --teach`` wrote. Raises InputError."""
    values, _ = read_toml(file, "marker file")
    try:
        return MarkerModel.from_table(values)
    except InputError as error:
        raise InputError(error.what, file=file, remedy="make it again with `syncline detect marker --teach`") from None


def marker_toml(model: MarkerModel) -> str:
    """A marker model as TOML text."""
    text = tomli_w.dumps(model.to_table())
    assert tomllib.loads(text)
    return text


def learn_marker_from_frame(video: VideoReader, box: tuple[float, float, float, float], start: int) -> MarkerModel:
    """Learn the marker model from a box x, y, w, h [px] of frame ``start`` (0 = first). Raises InputError."""
    for frame in video:
        if frame.frame == start:
            return learn_marker_model(frame.image(), box)
    raise InputError(f"there is no frame {start}", file=video.path, remedy="give --start an index, 0 is the first")
