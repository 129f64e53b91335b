"""`syncline intrinsics`: camera calibration from a video of a board."""

from __future__ import annotations

from collections import Counter
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from deploy.commands.common import Flag, Json, UnusedSeed, answer, check_file, check_range, closing_lines, parse_size
from deploy.offline.progress import progress_bar
from protocols.core.errors import InputError, Refused
from protocols.core.names import check_name, name_from_file

_MAX_FRAMES = 250  # most frames in which the board is searched
_MAX_RATE_HZ = 5.0  # most of them per second of video


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
    fisheye: Flag = False,
    field_of_view: float | None = None,
    model: str | None = None,
    json: Json = False,
    seed: UnusedSeed = 0,
) -> int:
    """Calibrate a camera's intrinsics (camera matrix and distortion) with a printed board, into a rig.toml.

    Film the flat board for half a minute so that it covers all parts of the image, tilted in different directions,
    near and far, with the zoom and focus that will be used. Exit status 3 if the views do not determine the intrinsics.
    All other entries of an existing rig.toml are kept, except comments.

    Example: syncline intrinsics board.mp4 --camera cam0 --board charuco --squares 8x5 --out rig.toml

    Without a board, --model or --field-of-view give the manufacturer's figure. Such intrinsics are approximate and are
    marked so (focal_std): `calibrate` then estimates the focal length from what moves, or refuses the camera.

    Example: syncline intrinsics cam0.mp4 --model gopro-wide --out rig.toml

    Example: syncline intrinsics cam0.mp4 --field-of-view 69 --out rig.toml

    Parameters
    ----------
    video
        A video file of the board, or a folder of images.
    out
        The rig.toml to write or to update.
    camera
        The camera's name in it; default: the video's name.
    board
        charuco: ChArUco board, which may be partly outside the image. chessboard: plain chessboard.
    squares
        Number of squares, columns x rows, as printed, not of the corners between them: 8x5.
    dictionary
        Marker dictionary of a ChArUco board, by its OpenCV name: 4X4_50, 5X5_100, APRILTAG_36H11, …
    ratio
        Side of a ChArUco marker divided by the side of a square.
    fisheye
        Use OpenCV's fisheye model, for fields of view of more than about 110 degrees.
    field_of_view
        Without a board: horizontal field of view in degrees, from the data sheet; distortion is assumed to be zero.
    model
        Without a board: the camera model, such as gopro-wide, oak-d, pixel-main, logitech-c920, raspberry-pi-camera-3.
    """
    check_file(out, "a rig.toml", video)
    grid = parse_size("--squares", squares, "give squares across x down, at least 4x4: 8x5", 4, 999)
    check_range("--ratio", ratio, 0.1, 0.99, "give a marker's side as a share of a square's")
    widest = 175.0 if fisheye else 150.0
    check_range("--field-of-view", field_of_view, 5.0, widest, f"give 5 to {widest:g} degrees")
    if model is not None and field_of_view is not None:
        raise InputError("--model and --field-of-view each give the field of view", remedy="keep one")
    from edge.detectors.board.description import Board, check_board
    from edge.devices.playback.video_reader import VideoReader
    from edge.lens.board import BoardView, board_views
    from edge.lens.coverage import coverage_map
    from edge.lens.models import FIELD_OF_VIEW_STD, find_lens_model, horizontal_field_of_view
    from edge.lens.solve import MIN_VIEWS, LensCalibration, calibrate_lens, intrinsics_from_field_of_view
    from protocols.core.files import write_atomically

    name = name_from_file(video.stem, video) if camera is None else check_name(camera, "--camera")
    known = None if model is None else find_lens_model(model)
    reader = VideoReader(video)
    fit: LensCalibration | None = None
    guess_std, unused = 0.0, ""
    if known is not None:
        lens = intrinsics_from_field_of_view(
            reader.info.size, horizontal_field_of_view(known, reader.info.size), known.fisheye
        )
        guess_std = known.std
    elif field_of_view is not None:
        lens, guess_std = intrinsics_from_field_of_view(reader.info.size, field_of_view, fisheye), FIELD_OF_VIEW_STD
    else:
        described = Board(board, grid, dictionary, ratio)
        check_board(described)
        total = reader.info.frames
        step = max(1, round(reader.info.fps / _MAX_RATE_HZ), -(-total // _MAX_FRAMES))
        step = 1 if video.is_dir() else step
        views: list[BoardView] = []
        reasons = Counter[str]()
        with progress_bar(f"looking for the board in {video.name}", quiet=json) as progress:
            for view in board_views(described, reader, step, reader.info.size[0], reasons):
                views.append(view)
                progress(f"{len(views)} views, frame {view.frame}", min(view.frame / total, 1.0) if total else 0.0)
        if count := reasons.total():
            what = "photographs" if video.is_dir() else "frames looked at"
            every = ", ".join(f"{number} {reason}" for reason, number in reasons.most_common())
            unused = f"{count} of {count + len(views)} {what} are not used: {every}"
        try:
            fit = calibrate_lens(views, reader.info.size, fisheye)
        except Refused as refusal:
            refusal.reason = "; ".join((refusal.reason, *reader.warnings, *filter(None, [unused])))
            raise
        lens = fit.intrinsics
        if fit.views < MIN_VIEWS:
            guess_std = fit.focal_std
    table: dict[str, Any] = {"name": name, **lens.table()}
    if guess_std:
        table["focal_std"] = guess_std
    write_atomically(out, _completed(out, name, table))
    document: dict[str, Any] = {"out": str(out), "camera": name, **table, "fisheye": lens.fisheye}
    if fit is not None:
        document |= {
            "views": fit.views,
            "rms_px": fit.rms_px,
            "focal_std": fit.focal_std,
            "border_std_px": fit.border_std_px if isfinite(fit.border_std_px) else None,
            "bow": fit.bow,
            "stretch": fit.stretch,
            "coverage": fit.coverage,
            "cells": fit.cells.tolist(),
        }
    focal = f"{name}: {'fisheye' if lens.fisheye else 'pinhole'}, focal length"
    if fit is None:
        lines = [
            f"{focal} {lens.focal:.1f} px ± {100 * guess_std:.0f} % from the field of view",
            "approximate: `syncline calibrate` refines it from what moves; a board is more precise",
        ]
    else:
        lines = [f"{focal} {lens.focal:.2f} px ± {100 * fit.focal_std:.2g} %, {fit.views} views"]
        if guess_std:
            lines.append(f"approximate: fewer than {MIN_VIEWS} different views; `syncline calibrate` refines it")
        if isfinite(fit.border_std_px):
            lines.append(f"rays at the picture's border ± {fit.border_std_px:.2g} px, where they are known least")
        if fit.bow:
            shape = (
                f"bowed by {fit.bow:.2g} of a square, its rows {100 * fit.stretch:+.2g} % farther apart than columns"
            )
            lines.append(f"the board is {shape}, which was allowed for")
        covered = f"corners in each part of the image ({100 * fit.coverage:.0f} %):"
        lines += [f"corners fit to {fit.rms_px:.3f} px; {covered}", *coverage_map(fit.cells)]
    # A video is meant to have more frames than different views.
    border = "" if fit is None else _unmeasured_border(fit.border_std_px, fit.border_limit_px)
    warnings = [*reader.warnings, *filter(None, [unused if video.is_dir() else "", border])]
    return answer(document | {"warnings": warnings}, [*lines, *closing_lines(warnings, [out])], json)


def _unmeasured_border(std: float, limit: float) -> str:
    """The warning of a lens that is extrapolated to the picture's border; empty where it is measured."""
    if std <= limit:
        return ""
    what = f"are known to ± {std:.2g} px only" if isfinite(std) else "are not known, the distortion folds over there"
    return f"rays at the picture's border {what}: show the board near the corners and the sides too"


def _completed(file: Path, name: str, table: dict[str, Any]) -> str:
    """The rig file's text with this camera's intrinsics; all other entries are kept. Raises InputError."""
    import tomli_w

    from protocols.core.files import read_toml
    from protocols.session.rig import read_rig

    values: dict[str, Any] = {}
    if file.exists():
        read_rig(file)  # errors in it are raised before anything is written
        values, _ = read_toml(file, "rig file")
    key = next((k for k, old in values.items() if k != "metadata" and old.get("name", k) == name), name)
    kept = {k: v for k, v in values.get(key, {}).items() if k not in ("matrix", "distortions", "fisheye", "focal_std")}
    values[key] = {**kept, **table}
    return tomli_w.dumps(values)
