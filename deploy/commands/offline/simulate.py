"""`syncline simulate`: writes a session of a simulated scene or a flight over the town, with its ground truth."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from protocols.core.errors import EXIT_DONE, InputError
from protocols.core.files import check_folder

_SECONDS, _NOISE_PX = 60.0, 0.5
_BODY_NOISE_PX = 2.0  # head tops and foot points are located less precisely than a ball
_PEOPLE = "people"


def simulate(
    scene: str,
    /,
    *,
    out: Path,
    seconds: float | None = None,
    cameras: int | None = None,
    seed: int = 0,
    noise_px: float | None = None,
    outliers: float | None = None,
    drops: float | None = None,
    frames: int | None = None,
    size: str | None = None,
    telemetry_hz: float | None = None,
    people: int | None = None,
    render: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write a session of a simulated scene: rig.toml, observations.csv and the ground truth.

    The ground truth is in truth_calibration.toml and truth_trajectory.csv (times on the first camera's clock).

    Scene people has people walking in a room: observations.csv contains everyone's head tops and foot points, with the
    labels person0-head, person0-foot, ...; truth_trajectory.csv their 3-D positions, truth_boxes.csv the bounding boxes
    in every frame.

    Scene town:SCENARIO is a drone that follows a car until it leaves the view: video.mp4, rig.toml, telemetry.csv and
    truth.csv (the car in every frame, also out of view). Scenarios: exit-bend (the default), exit-straight,
    turn-out-of-view, yaw, distractors, trees, bridge, lighting, off-road, partial, paper-3.3, paper-4.4.

    Example: syncline simulate marker --cameras 5 --seed 3 --out my-session

    Example: syncline simulate people --cameras 5 --people 5 --seconds 60 --out my-room

    Example: syncline simulate town:exit-bend --frames 90 --seed 3 --out my-flight

    Parameters
    ----------
    scene
        Name of the scene: marker (a room), marker-outdoor (a field), people (a room), or town:SCENARIO (a flight).
    out
        Folder to write; created if it does not exist.
    seconds
        Length of the recording (default 60); not for town.
    cameras
        Number of cameras, at least 2; default: the scene's own; not for town.
    seed
        Random seed: the same seed gives the same session.
    noise_px
        Detector noise, std of each coordinate in pixels (default 0.5, for people 2); not for town.
    outliers
        Fraction of false detections, 0 to 1 (default 0); only for marker scenes.
    drops
        Fraction of lost frames, 0 to 1; default: the scene's own; not for town.
    frames
        Number of frames for which the car is out of view; default: the scenario's own; only for town.
    size
        Image size, default 640x480; only for town.
    telemetry_hz
        Rate of the telemetry, 1 to 50 Hz (default 30); only for town.
    people
        Number of people, 1 to 12 (default 5); only for people.
    render
        Also write every camera's video, cam0.mp4, ...; only for people.
    json
        Print what was written as JSON.
    """
    check_folder(out)
    if seed < 0:
        raise InputError(f"--seed {seed} is negative", remedy="give 0 or more")
    marker_options: dict[str, object] = {
        "--seconds": seconds,
        "--cameras": cameras,
        "--noise-px": noise_px,
        "--outliers": outliers,
    }
    town_options: dict[str, object] = {"--frames": frames, "--size": size, "--telemetry-hz": telemetry_hz}
    people_options: dict[str, object] = {"--people": people, "--render": render or None}
    if scene.partition(":")[0] == "town":
        _refuse(marker_options | people_options | {"--drops": drops}, scene)
        return _fly(scene, out, seed, frames, size, 30.0 if telemetry_hz is None else telemetry_hz, json)
    unused_options: dict[str, object] = {"--outliers": outliers} if scene == _PEOPLE else people_options
    _refuse(town_options | unused_options, scene)
    seconds = _SECONDS if seconds is None else seconds
    if noise_px is None:
        noise_px = _BODY_NOISE_PX if scene == _PEOPLE else _NOISE_PX
    outliers = 0.0 if outliers is None else outliers
    if cameras is not None and not 2 <= cameras <= 64:
        raise InputError(f"--cameras {cameras} is out of range", remedy="give 2 to 64")
    if not 1.0 <= seconds <= 7200.0:
        raise InputError(f"--seconds {seconds:g} is out of range", remedy="give 1 to 7200")
    if not 0.0 <= outliers < 1.0 or (drops is not None and not 0.0 <= drops < 1.0) or not 0.0 <= noise_px <= 50.0:
        raise InputError("--outliers and --drops are shares below 1, --noise-px is 0 to 50", remedy="correct them")
    if scene == _PEOPLE:
        from deploy.simulation.people import write_people_session

        written = write_people_session(
            out,
            seconds=seconds,
            cameras=cameras,
            people=people,
            seed=seed,
            noise_px=noise_px,
            drops=drops,
            render=render,
        )
    else:
        from deploy.simulation.session import write_simulated_session

        written = write_simulated_session(
            scene, out, seconds=seconds, cameras=cameras, seed=seed, noise_px=noise_px, outliers=outliers, drops=drops
        )
    if json:
        import json as json_module

        print(json_module.dumps({"out": str(out), **written}))
    else:
        print(f"{written['cameras']} cameras, {written['rows']} observations in {out}")
        print(f"next: syncline calibrate {out} --out {out}-result")
    return EXIT_DONE


def _refuse(options: Mapping[str, object], scene: str) -> None:
    for option, value in options.items():
        if value is not None:
            raise InputError(f"{option} cannot be used with scene {scene}", remedy="leave it out")


def _fly(
    scene: str, out: Path, seed: int, frames: int | None, size: str | None, telemetry_hz: float, as_json: bool
) -> int:
    wanted = re.fullmatch(r"(\d{1,5})x(\d{1,5})", "640x480" if size is None else size)
    if wanted is None:
        raise InputError(f"--size {size} is no size", remedy="give width x height, for example 1280x720")
    if not 1.0 <= telemetry_hz <= 50.0:
        raise InputError(f"--telemetry-hz {telemetry_hz:g} is out of range", remedy="give 1 to 50")
    from deploy.simulation.flight import write_simulated_flight

    pixels = int(wanted[1]), int(wanted[2])
    written = write_simulated_flight(scene, out, seed=seed, frames=frames, size=pixels, rate_hz=telemetry_hz)
    if as_json:
        import json

        print(json.dumps({"out": str(out), **written}))
    else:
        begin, end = written["out_of_picture"]
        where = f"the car out of view in frames {begin} to {end - 1}" if end else "the car always in view"
        print(f"{written['frames']} frames in {written['video']}, {where}")
        target = ",".join(f"{value:g}" for value in written["target"])
        print(
            f"next: syncline track {written['video']} --target {target} --rig {out}/rig.toml "
            f"--telemetry {out}/telemetry.csv --out {out}-result"
        )
    return EXIT_DONE
