"""`syncline intrinsics`: a camera's lens from a video of a board."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from deploy.offline.progress import progress_bar
from protocols.core.errors import EXIT_DONE, InputError

_TRIED = 250  # frames that are looked at, at the most
_A_SECOND = 5.0  # … of each second


def intrinsics(
    video: Path,
    /,
    *,
    out: Path,
    camera: str | None = None,
    board: Literal["chessboard", "charuco"] = "charuco",
    squares: str = "8x5",
    dictionary: str = "4X4_50",
    ratio: float = 0.75,
    fisheye: Annotated[bool, Parameter(negative="")] = False,
    field_of_view: float | None = None,
    model: str | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
) -> int:
    """Measure a lens with a printed board: camera matrix and distortion, into a rig.toml.

    Film the flat board for half a minute so that it comes into all parts of the picture, tilted in different
    directions, near and far, with zoom and focus as they will be used. Exit status 3 if the views do not fix the lens.
    An existing rig.toml keeps everything else that stands in it, except its comments.

    Example: syncline intrinsics board.mp4 --camera cam0 --board charuco --squares 8x5 --out rig.toml

    Without a board, --model or --field-of-view tell what the maker says. Such a lens is a guess and its table says so
    (focal_std): `calibrate` then finds the focal length from the marker's path, or refuses the camera.

    Example: syncline intrinsics cam0.mp4 --model gopro-wide --out rig.toml

    Example: syncline intrinsics cam0.mp4 --field-of-view 69 --out rig.toml

    Parameters
    ----------
    video
        A video file of the board, or a folder of pictures.
    out
        The rig.toml to write or to complete.
    camera
        The camera's name in it; default: the video's name.
    board
        charuco: markers in the white squares; may be cut by the picture's border. chessboard: plain.
    squares
        Across x down, as printed: 8x5.
    dictionary
        Of a ChArUco board's markers, as OpenCV calls it: 4X4_50, 5X5_100, APRILTAG_36H11, …
    ratio
        A ChArUco marker's side as a share of a square's.
    fisheye
        OpenCV's fisheye model, for lenses of more than about 110 degrees.
    field_of_view
        Without a board: the picture's width in degrees, from the data sheet; distortion is taken as none.
    model
        Without a board: the camera, as gopro-wide, oak-d, pixel-main, logitech-c920, raspberry-pi-camera-3.
    json
        Print a summary as JSON.
    seed
        Accepted as everywhere; nothing here is drawn at random.
    """
    if out.is_dir():
        raise InputError("a folder of this name is in the way", file=out, remedy="give --out the name of a rig.toml")
    numbers = re.fullmatch(r"(\d{1,3})x(\d{1,3})", squares)
    if numbers is None or min(int(numbers[1]), int(numbers[2])) < 4:
        raise InputError(f"--squares {squares} is no board", remedy="give squares across x down, at least 4x4: 8x5")
    if not 0.1 <= ratio < 1.0:
        raise InputError(f"--ratio {ratio:g} is out of range", remedy="give a marker's side as a share of a square's")
    widest = 175.0 if fisheye else 150.0
    if field_of_view is not None and not 5.0 <= field_of_view <= widest:
        what = f"--field-of-view {field_of_view:g} is out of range"
        raise InputError(what, remedy=f"give 5 to {widest:g} degrees")
    if model is not None and field_of_view is not None:
        raise InputError("--model and --field-of-view each tell the field of view", remedy="keep one")
    from edge.devices.playback.video_reader import Film
    from edge.lens.board import Charuco, Chessboard, View, views_of
    from edge.lens.models import UNKNOWN_STD, angle_across, find_model
    from edge.lens.solve import LensFit, coverage_map, lens_from_angle, solve_lens
    from protocols.core.files import write_atomically

    name = video.stem if camera is None else camera
    if not name or name != name.strip() or '"' in name or name == "metadata":
        raise InputError(f"{name!r} is no name for a camera", remedy="give --camera letters, digits, - and _")
    known = None if model is None else find_model(model)
    film = Film(video)
    fit: LensFit | None = None
    guess_std = 0.0
    if known is not None:
        lens = lens_from_angle(film.info.size, angle_across(known, film.info.size), known.fisheye)
        guess_std = known.std
    elif field_of_view is not None:
        lens, guess_std = lens_from_angle(film.info.size, field_of_view, fisheye), UNKNOWN_STD
    else:
        grid = int(numbers[1]), int(numbers[2])
        finder = Chessboard(grid) if board == "chessboard" else Charuco(grid, dictionary, ratio)
        total = film.info.frames
        step = max(1, round(film.info.fps / _A_SECOND), -(-total // _TRIED))
        step = 1 if video.is_dir() else step
        views: list[View] = []
        with progress_bar(f"looking for the board in {video.name}", quiet=json) as tell:
            for view in views_of(finder, film, step, film.info.size[0]):
                views.append(view)
                tell(f"{len(views)} views, frame {view.frame}", min(view.frame / total, 1.0) if total else 0.0)
        fit = solve_lens(views, film.info.size, fisheye)
        lens = fit.lens
    table: dict[str, Any] = {
        "name": name,
        "size": [lens.width, lens.height],
        "matrix": lens.matrix.tolist(),
        "distortions": lens.distortions.tolist(),
    }
    if lens.fisheye:
        table["fisheye"] = True
    if guess_std:
        table["focal_std"] = guess_std
    write_atomically(out, _completed(out, name, table))
    if json:
        import json as json_module

        document: dict[str, Any] = {"out": str(out), "camera": name, **table, "fisheye": lens.fisheye}
        if fit is not None:
            document |= {
                "views": fit.views,
                "rms_px": fit.rms_px,
                "focal_std": fit.focal_std,
                "coverage": fit.coverage,
                "cells": fit.cells.tolist(),
            }
        print(json_module.dumps(document, allow_nan=False))
        return EXIT_DONE
    model = "fisheye" if lens.fisheye else "pinhole"
    if fit is None:
        print(f"{name}: {model}, focal length {lens.focal:.1f} px ± {100 * guess_std:.0f} % from the field of view")
        print("a guess: `syncline calibrate` finds it from the marker's path, a board tells it better")
    else:
        print(f"{name}: {model}, focal length {lens.focal:.2f} px ± {100 * fit.focal_std:.2g} %, {fit.views} views")
        print(f"corners fit to {fit.rms_px:.3f} px; corners in each part of the picture ({100 * fit.coverage:.0f} %):")
        for row in coverage_map(fit.cells):
            print(row)
    print(f"written: {out}")
    return EXIT_DONE


def _completed(file: Path, name: str, table: dict[str, Any]) -> str:
    """The rig file's text with this camera's lens in it; everything else stays. Raises InputError."""
    import tomli_w

    from protocols.session.rig import read_rig, read_toml

    values: dict[str, Any] = {}
    if file.exists():
        read_rig(file)  # what is wrong in it is told before anything is written
        values, _ = read_toml(file, "rig file")
    key = next((k for k, old in values.items() if k != "metadata" and old.get("name", k) == name), name)
    kept = {k: v for k, v in values.get(key, {}).items() if k not in ("matrix", "distortions", "fisheye", "focal_std")}
    values[key] = {**kept, **table}
    return tomli_w.dumps(values)
