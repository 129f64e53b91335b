"""Small videos for tests: of a shipped scene with its truth, and of numbered frames that can be read back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import tomli_w

from edge import scenes
from edge.scenes.marker.scene import MarkerScene
from protocols.geometry.types import Floats

Image = npt.NDArray[np.uint8]
TICKS = 90_000
_BITS, _BLOCK = 10, 16


def write_film(
    file: Path, pictures: Sequence[Image], times: Sequence[float] | Floats, codec: str = "libx264", crf: str = "12"
) -> None:
    """A video with these frames at these times [s]."""
    height, width = pictures[0].shape[:2]
    frames = zip((float(time) for time in times), pictures, strict=True)
    write_film_of(file, (width, height), frames, codec, crf)


def write_film_of(
    file: Path,
    size: tuple[int, int],
    frames: Iterable[tuple[float, Image]],
    codec: str = "libx264",
    crf: str = "12",
) -> None:
    """A video of frames (time [s], picture) as they come: a long one need not be in memory. size: (width, height)."""
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


def numbered(number: int) -> Image:
    """A picture (32, 160, 3) that carries a number below 1024 in black and white blocks."""
    picture = np.full((2 * _BLOCK, _BITS * _BLOCK, 3), 128, np.uint8)
    for bit in range(_BITS):
        picture[:, bit * _BLOCK : (bit + 1) * _BLOCK] = 235 if number >> bit & 1 else 20
    return picture


def number_in(picture: Image) -> int:
    """The number that ``numbered`` put into a picture."""
    middles = picture[_BLOCK, _BLOCK // 2 :: _BLOCK, 0]
    return sum(1 << bit for bit, value in enumerate(middles) if value > 128)


def film_scene(folder: Path, seconds: float, cameras: int, seed: int) -> tuple[MarkerScene, dict[str, Floats]]:
    """A video a camera of the scene ``marker`` and rig.toml with the lenses; the true times [s] of all frames.

    Cameras have their own rates and clock drifts, start when they like, fire irregularly and lose frames.
    """
    scene = scenes.get("marker", seed, cameras, mixed_fps=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    tables, truth = {}, {}
    for camera in scene.cameras:
        renderer = scene.renderer(camera.name, rng)
        begin = float(rng.uniform(0.0, 0.8))
        times = camera.capture_times(begin, 0, int((seconds - begin) * camera.fps), rng)
        times = times[(rng.random(len(times)) > 0.02) | (np.arange(len(times)) == 0)]
        pictures = [renderer.render(float(time)) for time in times]
        # 5 Mbit/s, as cameras write; at 24 there are 0.06, and the ball's edge is what the encoder makes of it.
        write_film(folder / f"{camera.name}.mp4", pictures, (times - times[0]) * camera.clock.rate, crf="18")
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
