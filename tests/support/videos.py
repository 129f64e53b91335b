"""Small test videos: of a shipped scene with ground truth, and of numbered frames that can be read back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import tomli_w

from edge import scenes
from edge.scenes import renderer_for
from edge.scenes.marker.scene import MarkerScene
from protocols.geometry.types import Floats, Image

TICKS = 90_000
_BITS, _BLOCK = 10, 16


def write_video(
    file: Path, pictures: Sequence[Image], times: Sequence[float] | Floats, codec: str = "libx264", crf: str = "12"
) -> None:
    """Write a video with these frames at these times [s]."""
    height, width = pictures[0].shape[:2]
    frames = zip((float(time) for time in times), pictures, strict=True)
    write_video_frames(file, (width, height), frames, codec, crf)


def write_video_frames(
    file: Path,
    size: tuple[int, int],
    frames: Iterable[tuple[float, Image]],
    codec: str = "libx264",
    crf: str = "12",
) -> None:
    """Write a video from an iterable of (time [s], image), without holding it in memory. size: (width, height)."""
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, TICKS)
        if codec == "libx264":
            stream.options = {"preset": "ultrafast", "crf": crf, "threads": "1"}
        for time, picture in frames:
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame.pts, frame.time_base = round(time * TICKS), Fraction(1, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def numbered_image(number: int) -> Image:
    """An image (32, 160, 3) that encodes a number below 1024 in black and white blocks."""
    picture = np.full((2 * _BLOCK, _BITS * _BLOCK, 3), 128, np.uint8)
    for bit in range(_BITS):
        picture[:, bit * _BLOCK : (bit + 1) * _BLOCK] = 235 if number >> bit & 1 else 20
    return picture


def read_number(picture: Image) -> int:
    """The number that ``numbered_image`` put into a picture."""
    middles = picture[_BLOCK, _BLOCK // 2 :: _BLOCK, 0]
    return sum(1 << bit for bit, value in enumerate(middles) if value > 128)


def record_scene_videos(folder: Path, seconds: float, cameras: int, seed: int) -> tuple[MarkerScene, dict[str, Floats]]:
    """Render one video per camera of the scene ``marker`` and rig.toml; returns the scene and all true frame times [s].

    Cameras have their own frame rates, clock drifts and start times, timestamp jitter and dropped frames.
    """
    scene = scenes.get_marker_scene("marker", seed, cameras, mixed_fps=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    tables, truth = {}, {}
    for camera in scene.cameras:
        renderer = renderer_for(scene, camera.name, rng)
        begin = float(rng.uniform(0.0, 0.8))
        times = camera.capture_times(begin, 0, int((seconds - begin) * camera.fps), rng)
        times = times[(rng.random(len(times)) > 0.02) | (np.arange(len(times)) == 0)]
        pictures = [renderer.render(float(time)) for time in times]
        # 5 Mbit/s, as real cameras; at crf 24 it would be 0.06 Mbit/s, with strong artefacts at the ball's edge.
        write_video(folder / f"{camera.name}.mp4", pictures, (times - times[0]) * camera.clock.rate, crf="18")
        lens = camera.intrinsics
        tables[camera.name] = {
            "name": camera.name,
            "size": [lens.width, lens.height],
            "matrix": lens.matrix.tolist(),
            "distortions": lens.distortions.tolist(),
        }
        truth[camera.name] = times
    (folder / "rig.toml").write_text(tomli_w.dumps(tables))
    return scene, truth
