"""`syncline demo`: the whole processing chain on one machine with simulated cameras, compared with the ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from deploy.commands.common import Flag, Json, check_range, check_seed
from protocols.core.errors import EXIT_DONE, EXIT_REFUSED


def demo(
    *,
    seconds: float | None = None,
    cameras: int | None = None,
    scene: Literal["marker", "people", "town"] = "marker",
    out: Path = Path("demo-out"),
    view: Flag = False,
    view_port: int = 8080,
    seed: int = 1,
    json: Json = False,
) -> int:
    """Calibrate simulated cameras that share no clock, and compare clock offsets and poses with the ground truth.

    --scene people: calibrated cameras detect people walking in a room, and the hub tracks them in 3-D.
    --scene town: a drone over a town; a ground station selects a car over MAVLink and receives its position, also
    while the car is out of view.
    Cameras, hub and recorder are processes that communicate over Zenoh on this machine. Prints a table of estimates
    and ground truth, and writes the log demo.mcap and report.html (people: tracks.csv) to --out. Exit status 3 if the
    errors exceed the limits in the table.

    Example: syncline demo --cameras 4 --seconds 40 --out demo-out

    Parameters
    ----------
    seconds
        Length of the recording; default 30, or 60 for people.
    cameras
        Number of cameras, 2 to 20; default 3, or 5 for people.
    scene
        marker: a marker waved in a room. people: five people walking in a room. town: a car seen from a drone.
    out
        Folder for the results.
    view
        Also start the live view for a browser; prints the address to open.
    view_port
        Port of the live view; 0 = any free port.
    seed
        Seed of the simulated scene: the same seed gives the same cameras and motion.
    """
    if cameras is None:
        cameras = 5 if scene == "people" else 3
    if seconds is None:
        seconds = 60.0 if scene == "people" else 30.0  # the limits for people hold for a recording of one minute
    check_seed(seed)
    check_range("--cameras", cameras, 2, 20)
    check_range("--seconds", seconds, 5.0, 3600.0)
    check_range("--view-port", view_port, 0, 65535)
    from deploy.demo.marker import DemoProcesses, DemoSettings, ProgressDisplay

    outcome: Any
    shown = ProgressDisplay("tracking" if scene == "town" else "filming", seconds, quiet=json)
    settings = DemoSettings(scene, seed, cameras, seconds, out, view_port if view else None)
    if scene == "town":
        from deploy.demo.flight import run_town

        with shown as display:
            outcome = run_town(out, seconds, seed, display, settings.view_port)
    elif scene == "people":
        from deploy.demo.people import PeopleDemoProcesses, compare_with_people

        people = PeopleDemoProcesses(settings)
        with shown as display:
            people.run(display)
        outcome = compare_with_people(out, seed, cameras)
    else:
        from deploy.evaluation.ground_truth import compare_with_truth

        fleet = DemoProcesses(settings)
        with shown as display:
            live = fleet.run(display)
        fleet.check_calibrated()
        outcome = compare_with_truth(out, scene, seed, cameras, live.first_calibration_s)
    if json:
        print(outcome.as_json())
    else:
        outcome.print(out)
    return EXIT_DONE if outcome.good else EXIT_REFUSED
