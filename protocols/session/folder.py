"""The session folder: rig.toml and observations.csv, read and written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from protocols.core.errors import InputError
from protocols.core.files import write_atomically
from protocols.geometry.types import Floats
from protocols.session.calibration import csv_cell
from protocols.session.observations import Observations, read_observations
from protocols.session.rig import Rig, misspelt_keys, read_rig

RIG_FILE = "rig.toml"
OBSERVATIONS_FILE = "observations.csv"
BOXES_FILE = "boxes.csv"
_MANY_TIMES = 10  # distinct ones that are all whole by chance: of stamps in tenths of a second one set in 10^10
_WRONG_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_SAME_INTERVAL = 0.2  # relative: rows that are so near a frame's interval apart, in such a unit, are in it
_MANY_ROWS, _SMALL_PICTURE = 100, 0.55
"""Rows of a camera, and the share of its width and of its height that they reach in every camera: those of pictures of
half the size reach a half."""
_FRACTION = 1.0
"""Greatest distance of fractions of an image from 0.5: beyond its borders too, as people's joints are placed. No target
stays so near the first pixel."""
_ENLARGEMENTS = (2, 3, 4)  # whole parts of a picture that detectors are given to save time
_MAX_OUTSIDE_SHARE, _MAX_INSIDE_SHARE = 0.01, 0.02
"""Share of rows outside the image above which a warning is given, and of these with u and v swapped, for false ones."""
_MANY_OUTSIDE_SHARE, _LARGE_PICTURE = 0.1, 1.1
"""Share of rows outside, and the share of width and of height that they reach, of no detector: people's joints are
placed beyond one border, where people are cut."""


def read_folder(folder: Path, observations: Path | None = None) -> tuple[Rig, Observations]:
    """Read a session folder; ``observations`` instead of its own observations.csv. Raises InputError."""
    if not folder.exists():
        raise InputError("this session does not exist", file=folder, remedy="give a session folder or a .mcap log")
    if not folder.is_dir():
        raise InputError("not a session", file=folder, remedy=f"give the folder that holds {RIG_FILE}, or a .mcap log")
    if not (folder / RIG_FILE).exists():
        raise InputError(
            f"no {RIG_FILE} in this folder",
            file=folder,
            remedy="write one: a table per camera, see `syncline simulate`",
        )
    rig = read_rig(folder / RIG_FILE)
    found = read_observations(observations or labelled_file(folder), rig.cameras)
    return rig, replace(found, warnings=found.warnings + column_warnings(rig, found) + misspelt_keys(rig))


def labelled_file(folder: Path) -> Path:
    """The observations.csv of a session folder. Raises InputError where it has a boxes.csv in its place."""
    file = folder / OBSERVATIONS_FILE
    if not file.exists() and (folder / BOXES_FILE).exists():
        what = f"no {OBSERVATIONS_FILE}, but {BOXES_FILE}: its people have no labels"
        remedy = "use `syncline calibrate` or `syncline follow`; in Python calibrate(deploy.people_session(folder))"
        raise InputError(what, file=folder, remedy=remedy)
    return file


def column_warnings(rig: Rig, observations: Observations) -> tuple[str, ...]:
    """Warnings for cameras with many rows outside their image or with times that are frame numbers, and for pixels of
    smaller images. Raises InputError for the first of `pixel_faults`, and for times in milliseconds."""
    for fault in pixel_faults(rig, observations).values():
        raise fault
    warnings = []
    for name, camera in rig.cameras.items():
        pixels = _pixels(observations, name)
        outside = _outside(pixels, camera.size)
        if outside > _MAX_OUTSIDE_SHARE * len(pixels):
            width, height = camera.size
            warnings.append(
                f"{name}: {outside} of {len(pixels)} rows lie outside its {width}x{height} image; check size, u, v"
            )
        times = np.unique(np.concatenate([np.zeros(0), *(track.time for track in observations.of_camera(name))]))
        # Fewer may be of every thousandth frame.
        frames = float(np.median(np.diff(times))) * camera.fps if len(times) >= _MANY_ROWS else 0.0
        for unit, factor in _WRONG_UNITS.items():
            if abs(frames / factor - 1.0) < _SAME_INTERVAL and not rig.shared_clock:
                text = (
                    f"{name}: its times are {unit}: {frames / camera.fps:.4g} apart, at {camera.fps:g} frames a second"
                )
                raise InputError(text, remedy=f"divide them by {factor:g}: times are seconds")
        if camera.fps > 1.0 and len(times) >= _MANY_TIMES and (times == np.rint(times)).all():
            warnings.append(
                f"{name}: all its times are whole numbers of seconds, though it films {camera.fps:g} frames a second; "
                "frame numbers have to be divided by the frame rate"
            )
    return (*warnings, *([text] if (text := small_pictures(rig, observations)) else []))


def small_pictures(rig: Rig, observations: Observations) -> str:
    """Warning where every camera's rows are as those of smaller images; "" elsewhere."""
    if not enlargements(rig, observations):
        return ""
    return (
        f"every camera's rows lie in the upper left of its picture, within {_reach(rig, observations):.2g} of its "
        "width and height: were they detected in smaller pictures than its size says?"
    )


def pixel_faults(rig: Rig, observations: Observations) -> dict[str, InputError]:
    """By camera, why its rows are no pixels of its image: fractions of it, u and v swapped, of a larger image."""
    return {
        name: fault
        for name, camera in rig.cameras.items()
        if (fault := _pixel_fault(name, camera.size, _pixels(observations, name)))
    }


def enlargements(rig: Rig, observations: Observations) -> tuple[int, ...]:
    """Whole factors by which all pixels can be enlarged and stay in the images, where every camera's rows lie in the
    upper left of its image, as those of pictures of half the size do; else none."""
    reach = _reach(rig, observations)
    return tuple(factor for factor in _ENLARGEMENTS if factor * reach < _SMALL_PICTURE * _ENLARGEMENTS[0])


def _reach(rig: Rig, observations: Observations) -> float:
    """The share of its width or height that the rows of any camera reach; 1 with less than two cameras of many rows."""
    found = {name: _pixels(observations, name) for name in rig.cameras}
    reach = [
        float((np.quantile(pixels, 0.99, axis=0) / rig.cameras[name].size).max())
        for name, pixels in found.items()
        if len(pixels) >= _MANY_ROWS
    ]
    return max(reach) if len(reach) > 1 else 1.0


def _pixels(observations: Observations, camera: str) -> Floats:
    return np.concatenate([np.zeros((0, 2)), *(track.pixels for track in observations.of_camera(camera))])


def _outside(pixels: Floats, size: tuple[int, int]) -> int:
    """Number of pixels (n, 2) beyond the image."""
    return int(((pixels < -1.0) | (pixels > np.array(size))).any(axis=1).sum())


def _pixel_fault(name: str, size: tuple[int, int], pixels: Floats) -> InputError | None:
    """What is wrong with the pixels (n, 2) of an image."""
    width, height = size
    if len(pixels) < _MANY_ROWS:
        return None
    if width * height > 1 and (np.abs(pixels - 0.5) <= _FRACTION).all():
        return InputError(
            f"{name}: all of its {len(pixels)} rows lie within one pixel of the first of its {width}x{height} image: "
            "they are fractions of it",
            remedy="multiply u by its width and v by its height",
        )
    outside = _outside(pixels, size)
    if outside <= _MAX_OUTSIDE_SHARE * len(pixels):
        return None
    rows = f"{name}: {outside} of {len(pixels)} rows lie outside its {width}x{height} image"
    if _outside(pixels[:, ::-1], size) < _MAX_INSIDE_SHARE * outside:
        return InputError(f"{rows}, and none with u and v swapped", remedy="swap u and v, or width and height in size")
    many = outside > _MANY_OUTSIDE_SHARE * len(pixels)
    if many and (np.quantile(pixels, 0.99, axis=0) > _LARGE_PICTURE * np.array(size)).all():
        return InputError(
            f"{rows}, at the right and below: they are pixels of a larger one",
            remedy="correct size and matrix, or scale u and v",
        )
    return None


def write_rig(file: Path, tables: dict[str, Any]) -> None:
    """Write rig.toml from its tables."""
    write_atomically(file, tomli_w.dumps(tables))


def write_observations(file: Path, observations: Observations) -> None:
    """Write observations.csv, by camera, label and time; floats with 17 significant digits."""
    sized = any(bool(np.isfinite(track.size).any()) for track in observations.tracks.values())
    labelled = len(observations.labels) > 1
    stated = any(track.std is not None for track in observations.tracks.values())
    header = ["camera", "frame", "time", "u", "v", *(["size"] if sized else []), *(["label"] if labelled else [])]
    header += ["cov_uu", "cov_uv", "cov_vv"] if stated else []
    lines = [",".join(header)]
    for track in observations.tracks.values():
        stds = np.full(len(track), np.nan) if track.std is None else track.std
        for frame, time, (u, v), size, std in zip(track.frame, track.time, track.pixels, track.size, stds, strict=True):
            cells = [track.camera, str(int(frame)), f"{time:.17g}", f"{u:.17g}", f"{v:.17g}"]
            if sized:
                cells.append(f"{size:.17g}" if np.isfinite(size) else "")
            if labelled:
                cells.append(csv_cell(track.label))
            if stated:
                cells += [f"{std**2:.17g}", "0", f"{std**2:.17g}"] if np.isfinite(std) else ["", "", ""]
            lines.append(",".join(cells))
    write_atomically(file, "\n".join(lines) + "\n")
