"""Makes a session from a folder of videos: detection in each video, merged into a session, with cached detections."""

from __future__ import annotations

import csv
import functools
import hashlib
import json
import os
import re
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from deploy.offline.people_session import read_people
from deploy.offline.progress import Progress
from deploy.offline.recognition import DETECTORS, Target, find_target
from deploy.offline.single_target import rows_of_head_and_foot, rows_of_one_target, rows_of_unlabelled_people
from edge.detectors import base as detector_base
from edge.detectors.base import Detector
from edge.detectors.board.description import BOARD_FILE, Board
from edge.detectors.board.detector import BoardDetector
from edge.detectors.marker.ball import MarkerModel
from edge.detectors.marker.factory import ball_detector, bright_or_tag_detector
from edge.detectors.plugins import detector_revision, is_plugin, load_detector, unknown_detector
from edge.devices.playback.video_reader import VIDEO_SUFFIXES, VideoReader, has_pyav, is_video
from edge.offline.detections import HEADER, VideoDetections, observations_csv, run_detector
from edge.offline.sampling import ENERGY_RATE, sound_energy
from edge.offline.video import MARKER_FILE, detect_objects, read_marker_model
from hub.api import RecordedSession
from hub.clocks.sound import sound_priors
from protocols.core.errors import InputError, Refused
from protocols.core.files import read_toml, write_together
from protocols.core.names import name_from_file
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, read_folder
from protocols.session.observations import Observations
from protocols.session.rig import Rig, read_rig

SESSION = "session"
_DETECTIONS, _STATE = "detections", "videos.json"
_LARGEST_SQUARE_M = 1.0  # of a board that a hand can move; 30 is likely to be millimetres
_NOTHING = "nothing"  # what is searched where nothing was recognised
_LEAST_ROWS = 3  # of a tag's corner in a video
_SAME_TIME_S = 1e-3  # s: containers round time stamps to milliseconds
_CHAPTER = re.compile(r"(G[HXP]\d\d|GOPR)(\d{4})", re.IGNORECASE)
"""GoPro's names of a recording's files: GH010042, GH020042, …; GOPR0042, GP010042, …"""
_LENS = ("matrix", "distortions", "fisheye", "focal_std")


@dataclass(frozen=True, slots=True)
class VideoFile:
    """One video of a folder. camera: the file's name without the suffix. size: of the file [bytes]."""

    camera: str
    path: Path
    size: int
    mtime_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class VideoSession(RecordedSession):
    """A session made of videos. summaries: one line a video. refusal: nothing that moves was found in them.

    clock_priors: the lags of their sound tracks, where these are of the same sounds.
    """

    summaries: tuple[str, ...] = ()
    refusal: Refused | None = None


def is_video_folder(folder: Path) -> bool:
    """Whether a folder contains videos and is not yet a session."""
    return has_videos(folder) and not (folder / OBSERVATIONS_FILE).exists()


def has_videos(folder: Path) -> bool:
    """Whether a folder contains videos, beside whatever else."""
    return folder.is_dir() and bool(_video_paths(folder))


def list_videos(folder: Path) -> tuple[list[VideoFile], list[str]]:
    """The folder's videos sorted by name, and warnings on skipped ones. Raises InputError."""
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "this folder does not exist"
        raise InputError(what, file=folder, remedy="give a folder of videos")
    paths = _video_paths(folder)
    if not paths:
        kinds = ", ".join(sorted(VIDEO_SUFFIXES))
        raise InputError("no video in this folder", file=folder, remedy=f"put one {kinds} file a camera in it")
    videos: list[VideoFile] = []
    warnings: list[str] = []
    contents: dict[tuple[int, str], str] = {}
    recordings: dict[tuple[str, str], str] = {}
    for path in paths:
        if chapter := _CHAPTER.fullmatch(path.stem):
            first = recordings.setdefault((chapter[1][:2].upper().replace("O", "P"), chapter[2]), path.name)
            if first != path.name:
                remedy = "join them, as with ffmpeg's concat demuxer, into one file a camera"
                raise InputError(f"{first} and {path.name} are chapters of one recording", file=folder, remedy=remedy)
        camera = name_from_file(path.stem, path)
        same = next((video.path.name for video in videos if video.camera == camera), None)
        if same is not None:
            remedy = "rename or remove one: a camera is named by its video"
            raise InputError(f"{same} and {path.name} would be one camera", file=folder, remedy=remedy)
        about = path.stat()
        key = (about.st_size, _digest(path))
        if key in contents:
            warnings.append(f"{path.name} is the same video as {contents[key]} and was left out")
            continue
        contents[key] = path.name
        videos.append(VideoFile(camera, path, about.st_size, about.st_mtime_ns))
    return videos, warnings


def session_from_videos(
    folder: str | Path,
    session: str | Path,
    progress: Progress = lambda text, share: None,
    marker: Path | None = None,
    detector: str = "marker",
) -> VideoSession:
    """Run a detector on every video and merge the detections into a session folder.

    session: folder that is created or updated: rig.toml, observations.csv and the detections of each video, which are
    reused if the video has not changed. marker: a marker.toml; default: the one in the folder, or the demo's orange
    ball. detector: one of ``recognition.DETECTORS``, a network's .toml file, or another package's detector. Persons,
    vehicles and those of networks and packages: one target at a time, because they are not associated between videos.
    Raises InputError if fewer than two videos can be read. Where auto finds nothing in them, the session is empty and
    carries the refusal.
    """
    _check_detector(detector)
    folder, session = Path(folder), Path(session)
    videos, warnings = list_videos(folder)
    if len(videos) < 2:
        what = "; ".join((f"there is only one video ({videos[0].path.name})", *warnings))
        raise InputError(what, file=folder, remedy="put those of the other cameras beside it")
    given, tables = _given_rig(folder)
    own_marker = marker or (folder / MARKER_FILE if (folder / MARKER_FILE).exists() else None)
    model = MarkerModel.default() if own_marker is None else read_marker_model(own_marker)
    paths = [video.path for video in videos]
    refusal: Refused | None = None
    try:
        target = find_target(folder, paths, detector, model, progress) if detector in DETECTORS else Target(detector)
    except Refused as refused:
        refusal, target = refused, Target(_NOTHING)
    detector, what = target.kind, target.text if detector in DETECTORS else "target"
    found, failed = _detect_all(videos, session, model, given, progress, target)
    warnings += failed
    if len(found) < 2:
        listed = "; ".join(warnings)
        raise InputError(f"fewer than two videos can be used ({listed})", file=folder, remedy="add or replace videos")
    # Their errors last for a step: they are for poses through measured lenses, not for lenses.
    measured = (_measured_lens(given, camera) for camera in found)
    of_ends = target.kind == "person" and all(lens is not None for lens in measured)
    lines: list[str] = list(target.notes)
    rows: list[str] = []
    unlabelled = [] if target.board is not None else rows_of_unlabelled_people(one.rows for one, _ in found.values())
    for video in videos:
        if video.camera not in found:
            continue
        one, kept = found[video.camera]
        several = False
        if target.board is None and not unlabelled:
            one, several = _one_target(video, one, what, warnings)
        rows += rows_of_head_and_foot(one.rows) if of_ends else one.rows
        again = " (kept from before)" if kept else ""
        if refusal is None:
            lines.append(f"{video.path.name}: {what} in {one.frames_with_detection} of {one.frames} frames{again}")
        warnings += [f"{video.path.name}: {warning}" for warning in one.warnings]
        if not one.rows and not several and refusal is None:
            warnings.append(f"{video.path.name}: no {what} in any of its frames")
        table = _camera_table(video, one, tables.get(video.camera, {}), warnings)
        tables[video.camera] = table | _ball_outline(detector, one, _measured_lens(given, video.camera))
    metadata = tables.pop("metadata", {})
    if target.board is not None:
        metadata |= _body_metadata(target.board, rows)
        warnings += _oversized(target.board, metadata)
        if "clock" not in metadata and _same_stamps([one for one, _ in found.values()]):
            metadata["in_step"] = True
    heard = {video.camera: sound_energy(video.path) for video in videos if video.camera in found}
    priors = sound_priors({name: sound for name, sound in heard.items() if sound is not None}, ENERGY_RATE)
    lines += [
        f"{name}: lag {prior.unix_minus_camera:+.3f} s by the sound tracks, against {next(iter(priors))}"
        for name, prior in list(priors.items())[1:]
    ]
    if refusal is None and target.kind in DETECTORS:
        metadata["target"] = target.text
    # [metadata] goes first, so that its keys do not end up in the last camera's table.
    rig_text = tomli_w.dumps({"metadata": metadata, **tables} if metadata else tables)
    every = observations_csv(unlabelled or rows)
    write_together({session / RIG_FILE: rig_text, session / OBSERVATIONS_FILE: every})
    if unlabelled:
        rig, people, _ = read_people(session / OBSERVATIONS_FILE, session / RIG_FILE)
        return VideoSession(
            rig, Observations({}), tuple(warnings), folder.name, priors, tuple(lines), refusal, people=people
        )
    if not rows:
        refusal = refusal or _unseen(target.board)
        rig = read_rig(session / RIG_FILE)
        if refusal is not None:
            refusal.warnings = tuple(warnings)
        return VideoSession(rig, Observations({}), tuple(warnings), folder.name, priors, tuple(lines), refusal)
    rig, observations = read_folder(session)
    return VideoSession(rig, observations, (*warnings, *observations.warnings), folder.name, priors, tuple(lines))


def _check_detector(name: str) -> None:
    """Raise InputError for a detector that is not known or not usable: once, not for every video."""
    if name not in DETECTORS:
        if not is_plugin(name):
            raise unknown_detector(name, DETECTORS)
        load_detector(name)


def _oversized(board: Board, metadata: dict[str, Any]) -> list[str]:
    if metadata.get("units", "m") != "m" or (board.size or 0.0) <= _LARGEST_SQUARE_M:
        return []
    remedy = f'give metres, or units = "mm" under [metadata] in {RIG_FILE}'
    return [f"{BOARD_FILE} says that a square is {board.size:g} m wide: {remedy}"]


def _unseen(board: Board | None) -> Refused | None:
    remedy = f"compare its squares and dictionary in {BOARD_FILE} with the print, or let --detector auto look"
    return None if board is None else Refused(f"this board is in no frame of the videos: {board.text}; {remedy}")


def _video_paths(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and is_video(path))


def _digest(path: Path) -> str:
    """Hash of the first and last 256 KiB of a file, which distinguishes videos of the same length."""
    piece = 1 << 18
    with path.open("rb") as file:
        begin = file.read(piece)
        file.seek(max(path.stat().st_size - piece, 0))
        return hashlib.sha256(begin + file.read(piece)).hexdigest()


def _given_rig(folder: Path) -> tuple[Rig | None, dict[str, Any]]:
    """The folder's rig.toml, validated, and its original tables by camera."""
    file = folder / RIG_FILE
    if not file.exists():
        return None, {}
    rig = read_rig(file)
    values, _ = read_toml(file, "rig file")
    metadata = values.pop("metadata", None)
    tables = {str(table.get("name", key)): table for key, table in values.items()}
    return rig, tables if metadata is None else {**tables, "metadata": metadata}


def _measured_lens(given: Rig | None, camera: str) -> Intrinsics | None:
    """A camera's measured intrinsics; None if they are only assumed."""
    if given is None or camera not in given.cameras or given.cameras[camera].focal_std > 0.0:
        return None
    return given.cameras[camera].intrinsics


def _camera_table(
    video: VideoFile, found: VideoDetections, given: dict[str, Any], warnings: list[str]
) -> dict[str, Any]:
    """A camera's table of rig.toml: the given values, completed by those of the video."""
    table = {"name": video.camera, "size": list(found.size), "fps": found.fps, **given}
    wanted = tuple(int(value) for value in table["size"])
    if wanted != found.size:
        turned = " (portrait and landscape mixed?)" if wanted == found.size[::-1] else ""
        shown = f"{found.size[0]}x{found.size[1]}"
        warnings.append(
            f"{video.path.name} is {shown}, its lens in {RIG_FILE} is for {wanted[0]}x{wanted[1]}{turned}: "
            "taken as a camera without intrinsics"
        )
        table = {key: value for key, value in table.items() if key not in _LENS} | {"size": list(found.size)}
    table.pop("ball_outline", None)
    return table


def _ball_outline(detector: str, found: VideoDetections, lens: Intrinsics | None) -> dict[str, bool]:
    """A ball's centre does not project to the centre of its outline: without measured intrinsics, the solver corrects
    that with the intrinsics it estimates."""
    wanted = detector == "marker" and (lens is None or (lens.width, lens.height) != found.size)
    return {"ball_outline": True} if wanted else {}


def _detect_all(
    videos: list[VideoFile],
    session: Path,
    model: MarkerModel,
    given: Rig | None,
    progress: Progress,
    target: Target,
) -> tuple[dict[str, tuple[VideoDetections, bool]], list[str]]:
    """Detections of each video with whether they come from the cache, and reasons why some could not be read."""
    kind = target.kind
    state = _read_state(session)
    found: dict[str, tuple[VideoDetections, bool]] = {}
    failed: dict[str, str] = {}
    lock, stop = threading.Lock(), threading.Event()
    shares = dict.fromkeys((video.camera for video in videos), 0.0)

    def report(video: VideoFile, text: str, share: float) -> None:
        with lock:
            shares[video.camera] = share
            progress(f"{video.path.name} {text}", sum(shares.values()) / len(shares))

    def look(video: VideoFile) -> None:
        lens = _measured_lens(given, video.camera)
        given_lens = None if lens is None else [lens.matrix.tolist(), lens.distortions.tolist()]
        key = _cache_key(video, model if kind == "marker" else None, given_lens, target)
        before = _cached_detections(session, video.camera, state.get(video.camera), key)
        if before is not None:
            found[video.camera] = before, True
            report(video, "kept", 1.0)
            return
        try:
            film = VideoReader(video.path)
            total = max(film.info.frames, 1)
            if kind == _NOTHING:
                one = VideoDetections((), film.info.frames, 0, 0, 0, film.info.size, film.info.fps, (0.0, 0.0))
            elif kind == "marker" or kind == "bright" or target.board is not None:
                detector = _point_detector(target, model, lens, film.info.size)
                one = run_detector(
                    film,
                    video.camera,
                    detector,
                    lambda frame: report(video, f"{frame} of {total}", min(frame / total, 1.0)),
                    stop.is_set,
                )
            else:
                one = detect_objects(
                    film, video.camera, kind, None, "mog2", lambda text, share: report(video, text, min(share, 1.0))
                )
        except InputError as error:
            with lock:
                failed[video.camera] = f"{video.path.name}: {error.what}; left out"
            return
        if stop.is_set():
            return
        with lock:
            found[video.camera] = one, False
            state[video.camera] = {"key": key, **asdict(replace(one, rows=()))}
            write_together(
                {
                    session / _DETECTIONS / f"{video.camera}.csv": observations_csv(one.rows),
                    session / _STATE: json.dumps(state, indent=1) + "\n",
                }
            )

    # Decoding and OpenCV release the GIL, so Python threads use all cores; OpenCV's own threads would oversubscribe.
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(max_workers=max(1, min(len(videos), os.cpu_count() or 1)))
    try:
        for work in [pool.submit(look, video) for video in videos]:
            work.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)
    return found, [failed[video.camera] for video in videos if video.camera in failed]


def _point_detector(target: Target, model: MarkerModel, lens: Intrinsics | None, size: tuple[int, int]) -> Detector:
    if target.board is not None:
        return BoardDetector(target.board)
    return ball_detector(model, lens, size) if target.kind == "marker" else bright_or_tag_detector("bright")


def _body_metadata(board: Board, rows: list[str]) -> dict[str, Any]:
    """What rig.toml says of a board: the points of its labels. Single tags count from a few frames in two videos on."""
    cells = list(csv.reader(rows))
    camera, label = (HEADER.split(",").index(name) for name in ("camera", "label"))
    seen = Counter((row[camera], row[label]) for row in cells)
    videos = Counter(name for (_, name), count in seen.items() if count >= _LEAST_ROWS)
    bodies = board.bodies([name for name, count in videos.items() if count >= 2])
    plain = {name: {label: point.tolist() for label, point in body.items()} for name, body in bodies.items()}
    symmetric = {"bodies_symmetric": True} if board.symmetric else {}
    return {**symmetric, "bodies": plain, "bodies_scale": "arbitrary" if board.size is None else "metric"}


def _same_stamps(found: list[VideoDetections]) -> bool:
    """Whether all videos have the same number of frames at the same times, as those of one recorder have."""
    first = found[0]
    return all(
        one.frames == first.frames and np.allclose(one.span, first.span, rtol=0.0, atol=_SAME_TIME_S) for one in found
    )


def _one_target(
    video: VideoFile, found: VideoDetections, what: str, warnings: list[str]
) -> tuple[VideoDetections, bool]:
    """The video's detections of its only target, and whether there are several instead; then none are left."""
    rows, removed, targets = rows_of_one_target(found.rows)
    if targets > 1:
        warnings.append(
            f"{video.path.name}: {targets} {what}s in it, and who is who in two videos is not known; left out"
        )
    elif removed:
        warnings.append(f"{video.path.name}: {removed} detections beside the {what} were taken as false and removed")
    return replace(found, rows=rows), targets > 1


def _cache_key(video: VideoFile, model: MarkerModel | None, lens: Any, target: Target) -> str:
    """Cache key: a hash of everything that affects a video's detections."""
    table = None if model is None else model.to_table()
    kind = target.kind
    revision = f"{kind} {target.board}" if kind in (*DETECTORS, _NOTHING) else detector_revision(kind)
    about = [VERSION, _program(), has_pyav(), video.path.name, video.size, video.mtime_ns, table, lens, revision]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


@functools.cache
def _program() -> str:
    """A hash of the sources of all detectors and of OpenCV's version: others may detect otherwise."""
    program = hashlib.sha256(cv2.__version__.encode())
    for source in sorted(Path(detector_base.__file__).parent.rglob("*.py")):
        program.update(source.read_bytes())
    return program.hexdigest()


def _read_state(session: Path) -> dict[str, Any]:
    try:
        state = json.loads((session / _STATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}  # no usable cache: all videos are processed again
    return state if isinstance(state, dict) else {}


def _cached_detections(session: Path, camera: str, entry: Any, key: str) -> VideoDetections | None:
    if not isinstance(entry, dict) or entry.get("key") != key:
        return None
    try:
        text = (session / _DETECTIONS / f"{camera}.csv").read_text(encoding="utf-8")
        values = {name: value for name, value in entry.items() if name != "key"}
        size, span = values["size"], values["span"]
        return VideoDetections(
            **{
                **values,
                "rows": tuple(text.splitlines()[1:]),
                "size": (int(size[0]), int(size[1])),
                "span": (float(span[0]), float(span[1])),
                "warnings": tuple(map(str, values["warnings"])),
            }
        )
    except (OSError, KeyError, TypeError, ValueError, IndexError):
        return None
