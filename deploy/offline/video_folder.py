"""From a folder of videos to a session: one detector a video, merged, kept beside the result, resumed."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import tomli_w

from deploy.offline.detect import MARKER_FILE, Found, detect_in, marker_detector, observations_text, read_marker
from edge.detectors.marker.ball import REVISION, MarkerModel
from edge.devices.playback.video_reader import VIDEO_SUFFIXES, Film, has_pyav
from protocols.core.errors import InputError
from protocols.core.files import write_together
from protocols.core.version import VERSION
from protocols.geometry.camera import Intrinsics
from protocols.session.folder import OBSERVATIONS_FILE, RIG_FILE, read_folder
from protocols.session.observations import Observations
from protocols.session.rig import Rig, read_rig, read_toml

Progress = Callable[[str, float], None]
DetectorName = Literal["marker", "person", "vehicle"]

SESSION = "session"
_DETECTIONS, _STATE = "detections", "videos.json"
_LENS = ("matrix", "distortions", "fisheye", "focal_std")


@dataclass(frozen=True, slots=True)
class VideoFile:
    """One video of the folder; camera: its name without the suffix."""

    camera: str
    path: Path
    size: int
    mtime_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Gathered:
    """A session made of videos. warnings: what was wrong with single videos. told: one line a video."""

    rig: Rig
    observations: Observations
    warnings: tuple[str, ...]
    told: tuple[str, ...]


def holds_videos(folder: Path) -> bool:
    """Whether a folder is one of videos and not a session yet."""
    return folder.is_dir() and not (folder / OBSERVATIONS_FILE).exists() and bool(_video_paths(folder))


def list_videos(folder: Path) -> tuple[list[VideoFile], list[str]]:
    """The folder's videos by name, and warnings of those that are left out. Raises InputError."""
    if not folder.is_dir():
        raise InputError("this folder does not exist", file=folder, remedy="give a folder of videos")
    paths = _video_paths(folder)
    if not paths:
        kinds = ", ".join(sorted(VIDEO_SUFFIXES))
        raise InputError("no video in this folder", file=folder, remedy=f"put one {kinds} file a camera in it")
    videos: list[VideoFile] = []
    warnings: list[str] = []
    contents: dict[tuple[int, str], str] = {}
    for path in paths:
        camera = path.stem
        if camera != camera.strip() or '"' in camera or camera == "metadata":
            remedy = "rename it: letters, digits, - and _"
            raise InputError(f"{camera!r} is no name for a camera", file=path, remedy=remedy)
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


def gather_session(
    folder: Path, session: Path, tell: Progress, marker: Path | None = None, detector: DetectorName = "marker"
) -> Gathered:
    """Detect the marker, or what else moves, in every video and merge what was seen to a session folder.

    session: is made or brought up to date: rig.toml, observations.csv, and what each video gave, so that a video that
    has not changed is not looked through again. marker: a marker.toml; default the folder's, or the
    demo's orange ball. detector: person and vehicle take videos in which one of them is at a time: who is who in
    two videos nobody knows yet. Raises InputError where fewer than two videos can be read.
    """
    videos, warnings = list_videos(folder)
    if len(videos) < 2:
        what = f"there is only one video ({videos[0].path.name})"
        raise InputError(what, file=folder, remedy="put those of the other cameras beside it")
    given, tables = _given_rig(folder)
    own_marker = marker or (folder / MARKER_FILE if (folder / MARKER_FILE).exists() else None)
    model = MarkerModel.default() if own_marker is None else read_marker(own_marker)
    found, failed = _detect_all(videos, session, model, given, tell, detector)
    warnings += failed
    if len(found) < 2:
        told = "; ".join(warnings)
        raise InputError(f"fewer than two videos can be used ({told})", file=folder, remedy="add or replace videos")
    lines: list[str] = []
    rows: list[str] = []
    for video in videos:
        if video.camera not in found:
            continue
        one, kept = found[video.camera]
        several = _several(one)
        if several:
            warnings.append(
                f"{video.path.name}: {several} {detector}s in it, and who is who in two videos is not known; left out"
            )
            one = replace(one, rows=())
        rows += one.rows
        again = " (kept from before)" if kept else ""
        lines.append(f"{video.path.name}: {detector} in {one.seen} of {one.frames} frames{again}")
        warnings += [f"{video.path.name}: {warning}" for warning in one.warnings]
        if not one.rows and not several:
            warnings.append(f"{video.path.name}: no {detector} in any of its frames")
        table = _table(video, one, tables.get(video.camera, {}), warnings)
        lens = _measured_lens(given, video.camera)
        # A ball's centre is not its outline's: with no lens to move it by, the solver does it with the one it finds.
        table.pop("ball_outline", None)
        if detector == "marker" and (lens is None or (lens.width, lens.height) != one.size):
            table["ball_outline"] = True
        tables[video.camera] = table
    metadata = tables.pop("metadata", {})
    # Keys of [metadata] must not land in the last camera's table: it goes first.
    rig_text = tomli_w.dumps({"metadata": metadata, **tables} if metadata else tables)
    write_together({session / RIG_FILE: rig_text, session / OBSERVATIONS_FILE: observations_text(rows)})
    if not rows:
        return Gathered(read_rig(session / RIG_FILE), Observations({}), tuple(warnings), tuple(lines))
    rig, observations = read_folder(session)
    return Gathered(rig, observations, (*warnings, *observations.warnings), tuple(lines))


def _video_paths(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")
    )


def _digest(path: Path) -> str:
    """Enough of a file to tell it from another of the same length: videos differ from the first frames on."""
    piece = 1 << 18
    with path.open("rb") as file:
        begin = file.read(piece)
        file.seek(max(path.stat().st_size - piece, 0))
        return hashlib.sha256(begin + file.read(piece)).hexdigest()


def _given_rig(folder: Path) -> tuple[Rig | None, dict[str, Any]]:
    """The folder's rig.toml, checked, and its tables by camera as they stand there."""
    file = folder / RIG_FILE
    if not file.exists():
        return None, {}
    rig = read_rig(file)
    values, _ = read_toml(file, "rig file")
    metadata = values.pop("metadata", None)
    tables = {str(table.get("name", key)): table for key, table in values.items()}
    return rig, tables if metadata is None else {**tables, "metadata": metadata}


def _measured_lens(given: Rig | None, camera: str) -> Intrinsics | None:
    """A camera's lens as far as it was measured: a guess says nothing of a picture's pixels."""
    if given is None or camera not in given.cameras or given.cameras[camera].focal_std > 0.0:
        return None
    return given.cameras[camera].intrinsics


def _table(video: VideoFile, found: Found, given: dict[str, Any], warnings: list[str]) -> dict[str, Any]:
    """A camera's table of rig.toml: what is given, completed by what the video tells."""
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
    return table


def _detect_all(
    videos: list[VideoFile],
    session: Path,
    model: MarkerModel,
    given: Rig | None,
    tell: Progress,
    kind: DetectorName,
) -> tuple[dict[str, tuple[Found, bool]], list[str]]:
    """What each video gave, and whether it was kept from before; and why some could not be read."""
    state = _read_state(session)
    found: dict[str, tuple[Found, bool]] = {}
    failed: dict[str, str] = {}
    lock, stop = threading.Lock(), threading.Event()
    shares = dict.fromkeys((video.camera for video in videos), 0.0)

    def told(video: VideoFile, text: str, share: float) -> None:
        with lock:
            shares[video.camera] = share
            tell(f"{video.path.name} {text}", sum(shares.values()) / len(shares))

    def look(video: VideoFile) -> None:
        lens = _measured_lens(given, video.camera)
        told_lens = None if lens is None else [lens.matrix.tolist(), lens.distortions.tolist()]
        key = _key(video, model if kind == "marker" else None, told_lens, kind)
        before = _kept(session, video.camera, state.get(video.camera), key)
        if before is not None:
            found[video.camera] = before, True
            told(video, "kept", 1.0)
            return
        try:
            film = Film(video.path)
            total = max(film.info.frames, 1)
            if kind == "marker":
                detector = marker_detector(model, lens, film.info.size)
                one = detect_in(
                    film,
                    video.camera,
                    detector,
                    lambda frame: told(video, f"{frame} of {total}", min(frame / total, 1.0)),
                    stop.is_set,
                )
            else:
                one = _moving(film, video.camera, kind, lambda text, share: told(video, text, min(share, 1.0)))
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
                    session / _DETECTIONS / f"{video.camera}.csv": observations_text(one.rows),
                    session / _STATE: json.dumps(state, indent=1) + "\n",
                }
            )

    # Decoding and OpenCV let go of the interpreter, so threads share the cores; OpenCV's own would be too many.
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(max_workers=max(1, min(len(videos), os.cpu_count() or 1)))
    try:
        for work in [pool.submit(look, video) for video in videos]:
            work.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)
    return found, [failed[video.camera] for video in videos if video.camera in failed]


def _moving(film: Film, camera: str, kind: str, tell: Progress) -> Found:
    """People or vehicles of a video, without the columns that a session does not know."""
    from deploy.offline.detect_moving import HEADER_EXTRA, find_moving, make_detector

    found = find_moving(film, camera, make_detector(kind, "mog2", film.info.fps), tell)
    extra = HEADER_EXTRA.count(",") + 1
    return replace(found, rows=tuple(row.rsplit(",", extra)[0] for row in found.rows))


def _several(found: Found) -> int:
    """How many different points are in a video, if more than one: the label is the last cell but one."""
    labels = {row.rsplit(",", 2)[1] for row in found.rows}
    return len(labels) if len(labels) > 1 else 0


def _key(video: VideoFile, model: MarkerModel | None, lens: Any, kind: str) -> str:
    """Changes with whatever changes a video's detections."""
    table = None if model is None else {"revision": REVISION, **model.to_table()}
    about = [VERSION, has_pyav(), video.path.name, video.size, video.mtime_ns, table, lens, kind]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def _read_state(session: Path) -> dict[str, Any]:
    try:
        state = json.loads((session / _STATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}  # nothing kept, or nothing that can be used: everything is looked through again
    return state if isinstance(state, dict) else {}


def _kept(session: Path, camera: str, entry: Any, key: str) -> Found | None:
    if not isinstance(entry, dict) or entry.get("key") != key:
        return None
    try:
        text = (session / _DETECTIONS / f"{camera}.csv").read_text(encoding="utf-8")
        values = {name: value for name, value in entry.items() if name != "key"}
        size, span = values["size"], values["span"]
        return Found(
            **{
                **values,
                "rows": tuple(text.splitlines()[1:]),
                "size": (int(size[0]), int(size[1])),
                "span": (float(span[0]), float(span[1])),
            }
        )
    except (OSError, KeyError, TypeError, ValueError, IndexError):
        return None
