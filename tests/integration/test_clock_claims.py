"""Machines that claim synchronised clocks: what the pictures say overrules them, what these leave open they choose."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from hub.live.agent import run_hub, status_message
from hub.live.live_hub import LiveHub, LiveSettings
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.clocks import CameraTime
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION, STATUS
from tests.integration.test_live_hub import SETTINGS, feed, messages
from tests.rigs import Path, Session, simulate
from tests.samples import eventually

UNIX_S = 1.7e9
PICTURES_SAY = "the pictures say"


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(72, 3, 20)


@pytest.fixture(scope="module")
def hub(session: Session) -> LiveHub:
    made = LiveHub(SETTINGS)
    feed(made, messages(session))
    assert made.calibration is not None
    assert len(made.calibration.cameras) == 3
    return made


def claim(
    session: Session, camera: str, off_s: float = 0.0, error_s: float = 0.002, boot: str = "boot0", tied: bool = True
) -> pb.AgentStatus:
    """The status of a machine whose Unix time is wrong by ``off_s`` and that says it is right to ``error_s``."""
    newest = max(t for t, name in zip(session.time, session.camera, strict=True) if name == camera)
    unix = UNIX_S + session.clocks[camera].reference_from_camera(CameraTime(newest)) + off_s
    message = pb.AgentStatus(schema_version=1, agent=camera, role="camera", boot_id=boot, state="running")
    message.gauges["clock_synchronised"] = float(tied)
    message.gauges["unix_minus_camera_s"] = unix - newest
    if tied:
        message.gauges["clock_error_s"] = error_s
    return message


def told(hub: LiveHub, *claims: pb.AgentStatus) -> list[str]:
    for one in ("cam0", "cam1", "cam2"):
        hub.handle(pb.AgentStatus(agent=one, role="camera"))  # claims nothing any more
    for one in claims:
        hub.handle(one)
    return hub.clock_contradictions()


def test_a_clock_that_is_wrong_is_told_with_what_it_claims_and_by_how_much(hub: LiveHub, session: Session) -> None:
    others = claim(session, "cam0"), claim(session, "cam2", error_s=0.0005)
    (text,) = told(hub, *others, claim(session, "cam1", off_s=1.3))
    assert text.startswith("cam1's clock says it is synchronised to 2 ms and cam")
    assert "the pictures say 1.3 s off" in text
    for off_s in (1.3, -1.3):
        (of_two,) = told(hub, others[0], claim(session, "cam1", off_s=off_s))
        text = "cam1's clock says it is synchronised to 2 ms and cam0's to 2 ms, the pictures say 1.3 s"
        assert of_two.startswith(text), "the reference is what the others are told against"
    (reference,) = told(hub, claim(session, "cam0", off_s=40.0), others[1], claim(session, "cam1"))
    assert reference.startswith("cam0's clock"), "where two of three agree, it is the third"
    assert "the pictures say 40 s off" in reference


def test_nothing_is_told_where_nothing_contradicts(hub: LiveHub, session: Session) -> None:
    right = [claim(session, name) for name in ("cam0", "cam1", "cam2")]
    assert told(hub, *right) == []
    assert told(hub, right[0], claim(session, "cam1", off_s=0.05)) == [], "a camera's own delay may be that much"
    assert told(hub, right[0], claim(session, "cam1", off_s=1.3, error_s=1.5)) == [], "it claims no more"
    assert told(hub, right[0], claim(session, "cam1", off_s=1.3, tied=False)) == [], "it claims nothing"
    assert told(hub, right[0], claim(session, "cam1", off_s=1.3, boot="boot1")) == [], "another clock than was solved"
    assert told(hub, claim(session, "cam1", off_s=1.3)) == [], "nobody to compare with"
    assert told(LiveHub(SETTINGS), *right) == [], "nothing is known yet"


def regular_session(seed: int, period: float = 2.5, cameras: int = 2, strangers: tuple[int, ...] = ()) -> Session:
    """Cameras that watch a motion which repeats itself exactly: lags a period apart fit alike."""
    rng = np.random.default_rng(seed)
    harmonic = np.arange(1.0, 4.0)[:, None] * np.ones((1, 3))
    amplitude = rng.uniform(0.4, 1.0, (3, 3)) / harmonic
    path = Path(harmonic / period, rng.uniform(0.0, 2.0 * np.pi, (3, 3)), 1.4 * amplitude / amplitude.sum(axis=0))
    return simulate(seed, cameras, 20, path=path, ppm=20.0, strangers=list(strangers))


def hub_after(session: Session, *claims: pb.AgentStatus) -> LiveHub:
    """The answer of a hub that has heard the claims before it solves for the first time."""
    made = LiveHub(LiveSettings(interval_s=1e9))
    for one in claims:
        made.handle(one)
    for message in messages(session):
        made.handle(message)
    made.tick(0.0, final=True)
    return made


@pytest.mark.parametrize("seed", [900, 902])
def test_of_lags_that_a_regular_motion_leaves_open_the_claimed_one_is_taken_and_that_is_told(seed: int) -> None:
    session = regular_session(seed)
    silent = hub_after(session)
    assert silent.calibration is None
    assert silent.refusal is not None, "the motion alone leaves periods open"
    claims = claim(session, "cam0", off_s=0.02), claim(session, "cam1", off_s=-0.03)
    believed = hub_after(session, *claims).calibration
    assert believed is not None
    assert abs(session.clock_error("cam1", "cam0", believed.cameras["cam1"].time_map)) < 2e-3, "the pictures' precision"
    (warning,) = [text for text in believed.warnings if "clocks claim" in text]
    assert warning.startswith("cam0–cam1: the motion alone leaves several lags open")


def test_a_claim_chooses_beside_a_camera_that_sees_nothing_of_it_too() -> None:
    session = regular_session(900, cameras=3, strangers=(2,))
    believed = hub_after(session, claim(session, "cam0"), claim(session, "cam1")).calibration
    assert believed is not None
    assert list(believed.cameras) == ["cam0", "cam1"]
    assert abs(session.clock_error("cam1", "cam0", believed.cameras["cam1"].time_map)) < 2e-3


@pytest.mark.parametrize(
    ("off_s", "error_s"),
    [(3.0, 0.002), (-1.2, 0.002), (0.0, 0.5)],
    ids=["no period", "half a period", "too vague to choose"],
)
def test_a_claim_that_fits_none_of_them_or_all_of_them_chooses_none(off_s: float, error_s: float) -> None:
    session = regular_session(902)
    hub = hub_after(session, claim(session, "cam0", error_s=error_s), claim(session, "cam1", off_s, error_s))
    assert hub.calibration is None
    assert hub.refusal is not None


@pytest.mark.parametrize("off_s", [3.0, -0.4, 0.0])
def test_where_the_pictures_tell_the_lag_no_claim_changes_it(session: Session, off_s: float) -> None:
    silent = hub_after(session).calibration
    claims = [claim(session, name, off_s=off_s * (name == "cam1")) for name in ("cam0", "cam1", "cam2")]
    told_so = hub_after(session, *claims).calibration
    assert silent is not None
    assert told_so is not None
    assert {n: c.time_map for n, c in told_so.cameras.items()} == {n: c.time_map for n, c in silent.cameras.items()}
    assert told_so.warnings == silent.warnings


def test_a_claim_of_another_run_of_the_agent_chooses_nothing() -> None:
    session = regular_session(902)
    hub = hub_after(session, claim(session, "cam0"), claim(session, "cam1", boot="boot1"))
    assert hub.calibration is None


def test_it_moves_no_estimate(hub: LiveHub, session: Session) -> None:
    assert hub.calibration is not None
    before = {name: camera.time_map for name, camera in hub.calibration.cameras.items()}
    told(hub, claim(session, "cam0"), claim(session, "cam1", off_s=1.3))
    hub.tick(2e6, final=True)
    assert {name: camera.time_map for name, camera in hub.calibration.cameras.items()} == before


def test_the_hubs_status_says_so(hub: LiveHub, session: Session) -> None:
    told(hub, claim(session, "cam0"), claim(session, "cam1", off_s=1.3))
    text = status_message(hub, "hub", "b", 0, []).message
    assert PICTURES_SAY in text
    assert text.endswith("3 cameras calibrated")


def test_a_running_hub_hears_it_from_the_cameras_statuses(session: Session) -> None:
    network, stop = MemoryHub(), threading.Event()
    with MemoryBus(network) as bus, MemoryBus(network) as own:
        statuses = bus.subscribe(STATUS)
        worker = threading.Thread(target=run_hub, args=(LiveHub(SETTINGS), own, "hub", stop))
        worker.start()
        try:
            topics = {"CameraInfo": CAMERA_INFO, "Observation": OBSERVATION}
            publishers = {}
            for message in messages(session):
                name = message.DESCRIPTOR.name, message.camera  # type: ignore[attr-defined]
                if name not in publishers:
                    publishers[name] = bus.publisher(topics[name[0]], name[1])
                publishers[name].put(message)
            for one in (claim(session, "cam0"), claim(session, "cam1", off_s=1.3)):
                bus.publisher(STATUS, one.agent).put(one)
            heard: list[str] = []

            def said() -> bool:
                heard.extend(r.message.message for r in statuses.drain() if r.agent == "hub")
                return any(PICTURES_SAY in text for text in heard)

            assert eventually(said, 60.0), heard[-3:]
        finally:
            stop.set()
            worker.join(60.0)
