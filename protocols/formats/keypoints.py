"""Keypoints of people and animals in other trackers' files: OpenPose, Pose2Sim, MMPose, DeepLabCut, SLEAP, and so on.

Every reader gives ``Keypoint`` rows by camera. OpenPose, RTMPose through Pose2Sim: a folder of JSON files, one a frame,
or a folder of such folders, one a camera. MMPose, COCO, MediaPipe: one JSON file a camera. SLEAP, DeepLabCut: one HDF5
file a camera (needs h5py). FreeMoCap: one .npy of all cameras. In all of them (0, 0) is the centre of the top-left
pixel, but MediaPipe's coordinates are shares of the image.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from protocols.core.errors import InputError
from protocols.core.files import read_text
from protocols.core.names import name_from_file
from protocols.geometry.types import Floats

FORMATS = ("openpose", "mmpose", "coco", "mediapipe", "sleap", "deeplabcut-h5", "freemocap-points")
# Names of the points in the order of each skeleton.
_SKELETONS = {
    "coco": """nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_wrist
        right_wrist left_hip right_hip left_knee right_knee left_ankle right_ankle""",
    "halpe": "head neck hip left_big_toe right_big_toe left_small_toe right_small_toe left_heel right_heel",
    "body_25": """nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist mid_hip right_hip
        right_knee right_ankle left_hip left_knee left_ankle right_eye left_eye right_ear left_ear left_big_toe
        left_small_toe left_heel right_big_toe right_small_toe right_heel""",
    "openpose_18": """nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist right_hip
        right_knee right_ankle left_hip left_knee left_ankle right_eye left_eye right_ear left_ear""",
    "mediapipe": """nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear
        right_ear mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist
        left_pinky right_pinky left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee
        left_ankle right_ankle left_heel right_heel left_foot_index right_foot_index""",
}
_COCO, _HALPE, _BODY_25, _OPENPOSE_18, _MEDIAPIPE = map(str.split, _SKELETONS.values())
_NAMES = {17: _COCO, 18: _OPENPOSE_18, 25: _BODY_25, 26: [*_COCO, *_HALPE], 33: _MEDIAPIPE}
_NAMES[133] = [*_COCO, *(f"point{i}" for i in range(17, 133))]  # COCO's whole body
_LIMBS = {("hip", "knee"): 0.245, ("knee", "ankle"): 0.246}
"""Lengths over the height of a person: D. Winter, "Biomechanics and Motor Control of Human Movement", figure 4.1."""


class Keypoint(NamedTuple):
    """One point of one person in one frame: pixels, or shares of the image where ``normalised``. score: 0..1."""

    frame: int
    person: str
    joint: str
    u: float
    v: float
    score: float


@dataclass(frozen=True, slots=True)
class CameraKeypoints:
    """What one camera saw. normalised: whether u, v are shares of the image. size: of the image [px], where given."""

    camera: str
    file: Path
    rows: list[Keypoint]
    normalised: bool = False
    size: tuple[int, int] | None = None


def limbs_of_height(height: float, labels: list[str]) -> list[tuple[str, str, float]]:
    """Scale bars of a person of this height: thighs and shanks between the joints that are among the labels."""
    known = set(labels)
    return [
        (f"{side}_{a}", f"{side}_{b}", share * height)
        for side in ("left", "right")
        for (a, b), share in _LIMBS.items()
        if {f"{side}_{a}", f"{side}_{b}"} <= known
    ]


def detect_format(path: Path) -> str | None:
    """The format of a file or folder of keypoints; None = none of these."""
    if path.is_dir():
        return "openpose" if any(_openpose_folders(path)) else None
    suffix = path.suffix.lower()
    if suffix in (".h5", ".hdf5", ".slp"):
        return _hdf5_format(path)
    if suffix == ".npy":
        return "freemocap-points"
    if suffix != ".json":
        return None
    document = _json(path)
    if isinstance(document, dict):
        if "people" in document:
            return "openpose"
        if "instance_info" in document:
            return "mmpose"
        if "annotations" in document and "images" in document:
            return "coco"
    first = document[0] if isinstance(document, list) and document and isinstance(document[0], dict) else {}
    if "instances" in first:
        return "mmpose"
    if "keypoints" in first and "image_id" in first:
        return "coco"
    if {"landmarks", "pose_landmarks"} & set(first):
        return "mediapipe"
    return None


def read(kind: str, paths: list[Path], camera: str | None) -> list[CameraKeypoints]:
    """The keypoints of some files or folders of one format, by camera. Raises InputError: file, what, remedy."""
    out: list[CameraKeypoints] = []
    for path in paths:
        try:
            if kind == "freemocap-points":
                out += _freemocap(path)
                continue
            if kind == "openpose":
                for folder in _openpose_folders(path) if path.is_dir() else ():
                    out.append(CameraKeypoints(_name(folder, camera), folder, list(_openpose(folder))))
                continue
            if kind == "sleap":
                out += _sleap(path, camera)
                continue
            reader = {
                "mmpose": _mmpose,
                "coco": _coco,
                "mediapipe": _mediapipe,
                "deeplabcut-h5": _deeplabcut,
            }[kind]
            out.append(CameraKeypoints(_name(path, camera), path, list(reader(path)), kind == "mediapipe"))
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, OSError) as error:
            what = f"this is no {kind} file as we know it ({type(error).__name__}: {str(error)[:80]})"
            if isinstance(error, KeyError):
                what = f"looks like a file of {kind}, but key {error.args[0]} is missing"
            raise InputError(what, file=path, remedy="export it again, or name its format with --format") from None
    twice = next((one for i, one in enumerate(out) if one.camera in {o.camera for o in out[:i]}), None)
    if twice is not None:
        raise InputError(f"a second file of camera {twice.camera!r}", file=twice.file, remedy="rename it")
    if not any(one.rows for one in out):
        raise InputError("no keypoint in it", file=paths[0], remedy="give files in which somebody was seen")
    return out


def _name(path: Path, camera: str | None) -> str:
    if camera is not None:
        return camera
    stem = (path.name if path.is_dir() else path.stem).removeprefix("results_")  # of MMPose's demos
    stem = re.split(r"DLC_|\.predictions|\.analysis|_(json|keypoints|openpose|detections?)$", stem)[0]
    return name_from_file(stem.rstrip("_-. ") or path.stem, path)


def _json(file: Path) -> Any:
    try:
        return json.loads(read_text(file, "JSON file"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {str(error)[:80]}", file=file, remedy="export it again") from None


def _joint(number: int, count: int) -> str:
    names = _NAMES.get(count)
    return f"point{number}" if names is None else names[number]


def _people(people: list[Any], frame: int, names: list[str] | None = None) -> Iterator[Keypoint]:
    """Rows of people given as (points (n, 2), scores (n,), name). names: of the points, where the file has them."""
    for number, (points, scores, name) in enumerate(people):
        points, scores = np.asarray(points, dtype=np.float64).reshape(-1, 2), np.asarray(scores, dtype=np.float64)
        for joint, ((u, v), score) in enumerate(zip(points, scores, strict=True)):
            if np.isfinite([u, v]).all() and (u, v) != (0.0, 0.0):
                label = names[joint] if names and len(names) == len(points) else _joint(joint, len(points))
                yield Keypoint(frame, name or f"p{number}", label, float(u), float(v), float(score))


def _openpose_folders(folder: Path) -> Iterator[Path]:
    """The folders with a JSON file a frame: this one, those in it, or those in its folder ``pose``."""
    if any(_is_frame(file) for file in folder.glob("*.json")):
        yield folder
        return
    for below in sorted((folder / "pose" if (folder / "pose").is_dir() else folder).iterdir()):
        if below.is_dir() and any(_is_frame(file) for file in below.glob("*.json")):
            yield below


def _is_frame(file: Path) -> bool:
    if re.search(r"\d+", file.stem) is None:
        return False
    if not file.is_file():
        return False
    with file.open(encoding="utf-8", errors="replace") as text:
        return '"people"' in text.read(4096)


def _openpose(folder: Path) -> Iterator[Keypoint]:
    for file in sorted(folder.glob("*.json")):
        numbers = re.findall(r"\d+", file.stem.removesuffix("_keypoints"))
        if not numbers:
            continue
        people = []
        document = _json(file)
        if not isinstance(document, dict) or not isinstance(document.get("people"), list):
            what = "looks like a frame of OpenPose, but key people is missing"
            raise InputError(what, file=file, remedy="export it again, or remove it")
        for person in document["people"]:
            values = np.asarray(person["pose_keypoints_2d"], dtype=np.float64).reshape(-1, 3)
            identity = person.get("person_id", [-1])
            number = identity[0] if isinstance(identity, list) and identity else identity
            named = f"p{number}" if isinstance(number, int) and number >= 0 else ""
            people.append((values[:, :2], values[:, 2], named))
        yield from _people(people, int(numbers[-1]))


def _mmpose(file: Path) -> Iterator[Keypoint]:
    document = _json(file)
    names: list[str] = []
    if isinstance(document, dict):
        given = document.get("meta_info", {}).get("keypoint_id2name", {})
        names = [given.get(str(joint), f"point{joint}") for joint in range(len(given))]
        document = document["instance_info"]
    # frame_id counts from 1 in results of videos and from 0 in others: the list's order counts.
    for number, frame in enumerate(document):
        people = []
        for one in frame["instances"]:
            points, name = one["keypoints"], f"p{one['track_id']}" if "track_id" in one else ""
            people.append((points, one.get("keypoint_scores", [1.0] * len(points)), name))
        yield from _people(people, number, names)


def _coco(file: Path) -> Iterator[Keypoint]:
    document = _json(file)
    frames: dict[Any, int] = {}
    names: dict[Any, list[str]] = {}
    annotations = document
    if isinstance(document, dict):
        frames = _frames_of_images(document["images"], file)
        names = {one.get("id"): one.get("keypoints", []) for one in document.get("categories", [])}
        annotations = document["annotations"]
    seen: dict[tuple[int, Any], list[Any]] = {}
    for one in annotations:
        values = np.asarray(one["keypoints"], dtype=np.float64).reshape(-1, 3)
        image = one["image_id"]
        frame = frames[image] if frames else int(re.findall(r"\d+", Path(str(image)).stem)[-1])
        # The third number is COCO's visibility 0, 1, 2 in annotations and a score in results.
        score = np.clip(values[:, 2], 0.0, 1.0)
        track = one.get("track_id")
        found = values[:, :2], score, "" if track is None else f"p{track}"
        seen.setdefault((frame, one.get("category_id")), []).append(found)
    for frame, category in sorted(seen, key=lambda key: key[0]):
        yield from _people(seen[frame, category], frame, names.get(category))


def _frames_of_images(images: list[Any], file: Path) -> dict[Any, int]:
    """The frame of each of COCO's images by its id: the last number in its file's name, or where these go on without a
    gap (from 1, say) its place among them; by the names' order where they have no numbers of their own."""
    files = [Path(str(image.get("file_name", image["id"]))) for image in images]
    folders = sorted({str(one.parent) for one in files})
    numbers = [int((re.findall(r"\d+", one.stem) or ["-1"])[-1]) for one in files]
    distinct = len(set(numbers)) == len(files)
    if len(folders) > 1 and not distinct:
        what = f"its images are of several folders ({', '.join(folders)[:80]})"
        raise InputError(what, file=file, remedy="export one file a camera")
    order = sorted(range(len(files)), key=lambda k: (numbers[k] if distinct else 0, str(files[k])))
    gaps = distinct and max(numbers, default=0) - min(numbers, default=0) >= len(files)
    return {images[k]["id"]: numbers[k] if gaps else place for place, k in enumerate(order)}


def _mediapipe(file: Path) -> Iterator[Keypoint]:
    for number, frame in enumerate(_json(file)):
        landmarks = frame.get("landmarks", frame.get("pose_landmarks")) or []
        people = landmarks if landmarks and isinstance(landmarks[0], list) else [landmarks]
        given = [
            ([(one["x"], one["y"]) for one in person], [one.get("visibility", 1.0) for one in person], "")
            for person in people
            if person
        ]
        yield from _people(given, int(frame.get("frame", number)))


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError("HDF5 files need h5py, which is not installed", remedy="pip install h5py") from None
    return h5py


def _hdf5_format(file: Path) -> str | None:
    try:
        with _h5py().File(file, "r") as data:
            if "tracks" in data and "node_names" in data:
                return "sleap"
            if "frames" in data and "instances" in data:
                return "sleap"
            return "deeplabcut-h5" if "df_with_missing" in data else None
    except OSError as error:
        raise InputError(f"not HDF5: {str(error)[:80]}", file=file, remedy="give the tracker's own file") from None


def _sleap(file: Path, camera: str | None) -> list[CameraKeypoints]:
    """SLEAP's analysis of one video, or the videos of its project file."""
    with _h5py().File(file, "r") as data:
        if "tracks" in data:
            return [CameraKeypoints(_name(file, camera), file, list(_sleap_analysis(data)))]
        videos = _slp(data)
        if len(videos) < 2:
            return [CameraKeypoints(_name(file, camera), file, rows) for rows in videos.values()]
        about = [json.loads(_text(one)) for one in data["videos_json"]]
        names = [str(one.get("filename") or one["backend"]["filename"]).replace("\\", "/") for one in about]
        return [CameraKeypoints(_name(Path(names[video]), camera), file, rows) for video, rows in videos.items()]


def _sleap_analysis(data: Any) -> Iterator[Keypoint]:
    tracks = _in_order(data["tracks"], ["track", "xy", "node", "frame"])
    names = [_text(name) for name in data["node_names"]]
    scores = np.ones(tracks[:, 0].shape)
    if "point_scores" in data:
        scores = _in_order(data["point_scores"], ["track", "node", "frame"])
    for person in range(tracks.shape[0]):
        node, frame = np.nonzero(np.isfinite(tracks[person]).all(axis=0))
        for n, f in zip(node.tolist(), frame.tolist(), strict=True):
            score = float(scores[person, n, f]) if np.isfinite(scores[person, n, f]) else 1.0
            u, v = tracks[person, :, n, f].tolist()
            yield Keypoint(f, f"p{person}", names[n], u, v, min(score, 1.0))


def _in_order(dataset: Any, axes: list[str]) -> Floats:
    """An array with its axes in SLEAP's order; sleap-io's files may have another one, and name it."""
    given = dataset.attrs.get("dims")
    dims = axes if given is None else json.loads(_text(given))
    return np.asarray(dataset, dtype=np.float64).transpose([dims.index(axis) for axis in axes])


def _slp(data: Any) -> dict[int, list[Keypoint]]:
    """SLEAP's own project file, by video: frames, instances, points."""
    about = json.loads(_text(data["metadata"].attrs["json"]))
    order = [link["id"] for link in about["skeletons"][0]["nodes"]]
    names = [about["nodes"][number]["name"] for number in order]
    # Before format 1.1 the centre of the top-left pixel was (0.5, 0.5).
    shift = 0.5 if float(data["metadata"].attrs.get("format_id", 1.2)) < 1.1 else 0.0
    out: dict[int, list[Keypoint]] = {}
    for frame in data["frames"][:]:
        rows = out.setdefault(int(frame["video"]), [])
        instances = data["instances"][int(frame["instance_id_start"]) : int(frame["instance_id_end"])]
        for number, one in enumerate(instances):
            predicted = int(one["instance_type"]) == 1
            points = data["pred_points" if predicted else "points"]
            part = points[int(one["point_id_start"]) : int(one["point_id_end"])]
            track = int(one["track"])
            for name, point in zip(names, part, strict=False):
                if bool(point["visible"]) and np.isfinite([point["x"], point["y"]]).all():
                    score = float(point["score"]) if predicted else 1.0
                    person = f"p{track if track >= 0 else number}"
                    u, v = float(point["x"]) - shift, float(point["y"]) - shift
                    rows.append(Keypoint(int(frame["frame_idx"]), person, name, u, v, min(score, 1.0)))
    return out


def _deeplabcut(file: Path) -> Iterator[Keypoint]:
    """The table that analyze_videos writes through pandas, read without it."""
    with _h5py().File(file, "r") as data:
        group = data["df_with_missing"]
        if "table" in group:
            table = group["table"]
            columns = _plain_pickle(bytes(table.attrs["values_block_0_kind"]))
            frames, values = np.asarray(table["index"]), np.asarray(table["values_block_0"], dtype=np.float64)
        else:
            frames, values = np.asarray(group["axis1"]), np.asarray(group["block0_values"], dtype=np.float64)
            levels = sum(re.fullmatch(r"axis0_level\d+", key) is not None for key in group)
            parts = []
            for level in range(levels):
                names = [_text(name) for name in group[f"axis0_level{level}"]]
                parts.append([names[code] for code in np.asarray(group[f"axis0_label{level}"])])
            columns = list(zip(*parts, strict=True))
    for column in range(0, values.shape[1] - 2, 3):
        name = tuple(str(part) for part in columns[column])
        if name[-1] != "x":
            raise ValueError(f"column {column} is {name[-1]}, not x")
        person = name[1] if len(name) == 4 else "p0"
        for frame, (u, v, score) in zip(frames.tolist(), values[:, column : column + 3].tolist(), strict=True):
            if np.isfinite([u, v, score]).all():
                yield Keypoint(int(frame), person, name[-2], u, v, score)


def _plain_pickle(data: bytes) -> Any:
    """Unpickle texts, lists and tuples; anything else in a foreign file could run code."""
    import io
    import pickle

    class _Plain(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            raise ValueError(f"the file holds {module}.{name}")

    return _Plain(io.BytesIO(data), encoding="latin-1").load()


def _freemocap(file: Path) -> list[CameraKeypoints]:
    """``…2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy``: (cameras, frames, points, 2 or 3)."""
    values: Floats = np.load(file, mmap_mode="r", allow_pickle=False)
    if values.ndim != 4 or values.shape[3] < 2:
        raise ValueError(f"an array of shape {values.shape}, not (cameras, frames, points, 2)")
    out = []
    count = values.shape[2]
    for camera in range(values.shape[0]):
        mine = np.asarray(values[camera], dtype=np.float64)
        frame, point = np.nonzero(np.isfinite(mine[..., :2]).all(axis=2))
        score = mine[frame, point, 2] if mine.shape[2] > 2 else np.ones(len(frame))
        # Of MediaPipe's whole body the first 33 are the body's.
        names = [_MEDIAPIPE[i] if count >= 33 and i < 33 else f"point{i}" for i in range(count)]
        sure = np.clip(np.where(np.isfinite(score), score, 1.0), 0.0, 1.0)
        places = mine[frame, point, :2].tolist()
        rows = [
            Keypoint(f, "p0", names[p], u, v, one)
            for f, p, (u, v), one in zip(frame.tolist(), point.tolist(), places, sure.tolist(), strict=True)
        ]
        out.append(CameraKeypoints(f"cam_{camera}", file, rows))
    return out


def _text(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)
