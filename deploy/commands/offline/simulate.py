"""`syncline simulate`: writes a session of a simulated scene or a flight over the town, with its ground truth."""

from __future__ import annotations

from pathlib import Path

from deploy.commands.common import Flag, Json, answer, check_range, check_seed, parse_size, refuse
from protocols.core.files import check_folder

_SECONDS, _NOISE_PX = 60.0, 0.5  # default length; a ball's centre is located this well
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
    render: Flag = False,
    json: Json = False,
) -> int:
    """Write a session of a simulated scene: rig.toml, observations.csv and the ground truth.

    The ground truth is in truth_calibration.toml and truth_trajectory.csv (times on the first camera's clock).

    Scene people has people walking in a room: observations.csv contains everyone's head tops and foot points, with the
    labels person0-head, person0-foot, ...; truth_trajectory.csv their 3-D positions, truth_boxes.csv the bounding boxes
    in every frame.

    Scene town:SCENARIO is a drone that follows a car until it leaves the view: video.mp4, rig.toml, telemetry.csv and
    truth.csv (the car in every frame, also out of view). Scenarios: exit-bend (the default), exit-straight,
    turn-out-of-view, yaw, distractors, trees, bridge, lighting, off-road, partial, cut, climb, far,
    paper-3.3, paper-4.4.

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
    """
    check_folder(out)
    check_seed(seed)
    marker_options: dict[str, object] = {
        "--seconds": seconds,
        "--cameras": cameras,
        "--noise-px": noise_px,
        "--outliers": outliers,
    }
    town_options: dict[str, object] = {"--frames": frames, "--size": size, "--telemetry-hz": telemetry_hz}
    people_options: dict[str, object] = {"--people": people, "--render": render or None}
    if scene.partition(":")[0] == "town":
        refuse(marker_options | people_options | {"--drops": drops}, f"scene {scene}")
        return _fly(scene, out, seed, frames, size, 30.0 if telemetry_hz is None else telemetry_hz, json)
    unused_options: dict[str, object] = {"--outliers": outliers} if scene == _PEOPLE else people_options
    refuse(town_options | unused_options, f"scene {scene}")
    seconds = _SECONDS if seconds is None else seconds
    if noise_px is None:
        noise_px = _BODY_NOISE_PX if scene == _PEOPLE else _NOISE_PX
    outliers = 0.0 if outliers is None else outliers
    check_range("--cameras", cameras, 2, 64)
    check_range("--seconds", seconds, 1.0, 7200.0)
    check_range("--outliers", outliers, 0.0, 0.99)
    check_range("--drops", drops, 0.0, 0.99)
    check_range("--noise-px", noise_px, 0.0, 50.0)
    if scene == _PEOPLE:
        from deploy.simulation.session import write_people_session

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
    lines = (
        f"{written['cameras']} cameras, {written['rows']} observations in {out}",
        f"next: syncline calibrate {out} --out {out}-result",
    )
    return answer({"out": str(out), **written}, lines, json)


def _fly(
    scene: str, out: Path, seed: int, frames: int | None, size: str | None, telemetry_hz: float, as_json: bool
) -> int:
    pixels = parse_size("--size", size or "640x480", "give width x height, for example 1280x720")
    check_range("--telemetry-hz", telemetry_hz, 1.0, 50.0)
    from deploy.simulation.flight import write_simulated_flight

    written = write_simulated_flight(scene, out, seed=seed, frames=frames, size=pixels, rate_hz=telemetry_hz)
    begin, end = written["out_of_picture"]
    where = f"the car out of view in frames {begin} to {end - 1}" if end else "the car always in view"
    target = ",".join(f"{value:g}" for value in written["target"])
    files = f"--rig {out}/rig.toml --telemetry {out}/telemetry.csv --out {out}-result"
    lines = (
        f"{written['frames']} frames in {written['video']}, {where}",
        f"next: syncline track {written['video']} --target {target} {files}",
    )
    return answer({"out": str(out), **written}, lines, as_json)
