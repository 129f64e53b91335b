"""Detection of people or vehicles in a folder of videos, one process a video, into a log that can be followed again."""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from deploy.offline.exchange.session_log import camera_info, write_observation_log
from deploy.offline.follow.objects import Kind
from deploy.offline.progress import Progress
from deploy.offline.video_folder import VideoFile, list_videos
from protocols.core.clocks import NANOSECONDS
from protocols.core.errors import InputError
from protocols.messages import syncline_pb2 as pb
from protocols.validation.rules import SCHEMA_VERSION

if TYPE_CHECKING:
    from deploy.offline.follow.calibration import GivenCalibration
    from edge.detectors.base import Detection, Detector
    from edge.devices.playback.video_reader import VideoReader

_POLL_S = 0.2  # s: between two looks at the workers
_shares: Any = None  # in a worker process: the share of each video that is done


@dataclass(frozen=True, slots=True)
class _Job:
    index: int
    path: Path
    camera: str
    kind: Kind
    detector: str | None
    seed: int


@dataclass(frozen=True, slots=True)
class _Detected:
    """messages: serialised observations of all frames of a video."""

    messages: list[bytes]
    warnings: tuple[str, ...]


def detect_videos(
    folder: Path,
    known: GivenCalibration,
    kind: Kind,
    log: Path,
    *,
    detector: str | None = None,
    seed: int = 0,
    progress: Progress = lambda text, share: None,
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Run a detector on every video and write the observations of all frames to ``log``.

    detector: a name or a network's .toml, see ``edge.detectors.plugins.load_detector``; default: the shipped detector
    of moving people or vehicles. Returns the videos by camera, and warnings. Raises InputError.
    """
    videos, warnings = list_videos(folder)
    videos, unreadable = _checked_videos(videos, known)
    warnings += unreadable
    if detector is not None:
        from edge.detectors.plugins import load_detector

        load_detector(detector, kind=kind, seed=seed)  # a wrong model is reported once, and before the work
    jobs = [_Job(i, video.path, video.camera, kind, detector, seed) for i, video in enumerate(videos)]
    done = _run(jobs, progress)
    for video, one in zip(videos, done, strict=True):
        warnings += [f"{video.path.name}: {warning}" for warning in one.warnings]
    messages = [pb.Observation.FromString(data) for one in done for data in one.messages]
    infos = [camera_info(known.rig, video.camera) for video in videos]
    log.unlink(missing_ok=True)
    write_observation_log(log, infos, known.rig, messages, known.calibration.cameras)
    return {video.camera: video.path for video in videos}, tuple(warnings)


def _checked_videos(videos: Sequence[VideoFile], known: GivenCalibration) -> tuple[list[VideoFile], list[str]]:
    """The videos that can be opened, and a warning for each other one. Raises InputError for a video of an unknown
    camera or of another picture size than its lens, and where none can be opened."""
    from edge.devices.playback.video_reader import VideoReader

    opened: list[VideoFile] = []
    warnings: list[str] = []
    for video in videos:
        if video.camera not in known.names:
            what = f"camera {video.camera!r} is not in the calibration ({', '.join(known.names)})"
            raise InputError(what, file=video.path, remedy="name each video after its camera, or remove this one")
        try:
            size, lens = VideoReader(video.path).info.size, known.sizes.get(video.camera)
        except InputError as error:
            if not opened and video is videos[-1]:
                raise
            warnings.append(f"{video.path.name}: {error.what}; left out")
            continue
        opened.append(video)
        if lens is not None and size != lens:
            what = f"this video is {size[0]}x{size[1]}, the calibration of {video.camera} is for {lens[0]}x{lens[1]}"
            turned = "turn it: a copy may have lost its rotation" if size == lens[::-1] else ""
            raise InputError(what, file=video.path, remedy=turned or "calibrate at this picture size")
    return opened, warnings


def _run(jobs: list[_Job], progress: Progress) -> list[_Detected]:
    """Run the jobs in as many processes as there are cores; in this one if there is only one."""
    workers = min(len(jobs), os.cpu_count() or 1)
    if workers == 1:
        return [
            _detect(job, lambda share, job=job: progress(job.path.name, (job.index + share) / len(jobs)))  # type: ignore[misc]
            for job in jobs
        ]
    context = multiprocessing.get_context("spawn")  # a fork would inherit the locks of OpenCV's and Zenoh's threads
    shares = context.Array("d", len(jobs), lock=False)
    with ProcessPoolExecutor(workers, context, _set_shares, (shares,)) as pool:
        futures: list[Future[_Detected]] = [pool.submit(_detect_in_worker, job) for job in jobs]
        waiting: set[Future[_Detected]] = set(futures)
        try:
            while waiting:
                finished, waiting = wait(waiting, _POLL_S, "FIRST_COMPLETED")
                for one in finished:
                    one.result()
                share = sum(cast("Sequence[float]", shares)) / len(jobs)
                progress(f"{len(jobs) - len(waiting)} of {len(jobs)} videos", share)
        except BrokenProcessPool:
            what = "a process that detected in a video was ended, most likely for lack of memory"
            raise InputError(what, remedy="close other programs, or give fewer videos at a time") from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        return [future.result() for future in futures]


def _set_shares(shares: Any) -> None:
    global _shares
    _shares = shares


def _detect_in_worker(job: _Job) -> _Detected:
    import cv2

    cv2.setNumThreads(1)  # one process a core already

    def report(share: float) -> None:
        _shares[job.index] = share

    return _detect(job, report)


def _detect(job: _Job, report: Callable[[float], None]) -> _Detected:
    from edge.agents.camera import detection_message
    from edge.devices.playback.video_reader import VideoReader

    video = VideoReader(job.path)
    shipped = job.detector in (None, job.kind)
    frames = (_moving_detections if shipped else _network_detections)(video, job, report)
    messages = [
        pb.Observation(
            schema_version=SCHEMA_VERSION, camera=job.camera, boot_id="video", sequence=frame, frame=frame,
            device_time_ns=round(time * NANOSECONDS), detections=[detection_message(one) for one in found],
        ).SerializeToString()
        for frame, time, found in frames
    ]  # fmt: skip
    if not messages:
        raise InputError("no frame can be read from this file", file=job.path, remedy="replace it")
    return _Detected(messages, video.warnings)


Frames = list[tuple[int, float, list["Detection"]]]


def _network_detections(video: VideoReader, job: _Job, report: Callable[[float], None]) -> Frames:
    """Frame number, time [s] and detections of all frames, by a detector that was asked for."""
    from edge.detectors.plugins import load_detector

    assert job.detector is not None
    return _all_frames(video, load_detector(job.detector, kind=job.kind, fps=video.info.fps, seed=job.seed), report)


def _all_frames(video: VideoReader, detector: Detector, report: Callable[[float], None]) -> Frames:
    from edge.offline.detections import detected_frames

    total = max(video.info.frames, 1)
    out: Frames = []
    for frame, found in detected_frames(video, detector):
        out.append((frame.frame, frame.time, [one for one in found if math.isfinite(one.u) and math.isfinite(one.v)]))
        report(min(frame.frame / total, 1.0))
    return out


def _moving_detections(video: VideoReader, job: _Job, report: Callable[[float], None]) -> Frames:
    """The same by the shipped detectors, which first learn the background; without tracks that were never confirmed."""
    from edge.offline.moving import confirmed_labels, learn_background, moving_detector

    detector = moving_detector(job.kind, "mog2", video.info.fps)
    learn_background(video, detector)
    frames = _all_frames(video, detector, report)
    names = confirmed_labels({frame: (time, found) for frame, time, found in frames}, detector)
    return [(frame, time, [one for one in found if one.label in names]) for frame, time, found in frames]
