"""External clock priors: images overrule them, and where images are ambiguous a prior selects the lag."""

from __future__ import annotations

import numpy as np
import pytest

from hub.live.agent import run_hub, status_message
from hub.live.live_hub import LiveHub, LiveSettings
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.core.clocks import CameraTime
from protocols.messages import syncline_pb2 as pb
from protocols.topics import CAMERA_INFO, OBSERVATION, STATUS
from tests.integration.live.test_live_hub import SETTINGS, feed, messages
from tests.support.rigs import Path, Session, simulate
from tests.support.samples import eventually
from tests.support.threads import running

UNIX_S = 1.7e9
CONTRADICTION = "the images show a difference"


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


def clock_status(
    session: Session,
    camera: str,
    off_s: float = 0.0,
    error_s: float = 0.002,
    boot: str = "boot0",
    synchronised: bool = True,
) -> pb.AgentStatus:
    """Status of a machine whose Unix time is wrong by ``off_s`` and reported as accurate to ``error_s``."""
    newest = max(t for t, name in zip(session.time, session.camera, strict=True) if name == camera)
    unix = UNIX_S + session.clocks[camera].reference_from_camera(CameraTime(newest)) + off_s
    message = pb.AgentStatus(schema_version=1, agent=camera, role="camera", boot_id=boot, state="running")
    message.gauges["clock_synchronised"] = float(synchronised)
    message.gauges["unix_minus_camera_s"] = unix - newest
    if synchronised:
        message.gauges["clock_error_s"] = error_s
    return message


def contradictions(hub: LiveHub, *priors: pb.AgentStatus) -> list[str]:
    for one in ("cam0", "cam1", "cam2"):
        hub.handle(pb.AgentStatus(agent=one, role="camera"))  # no prior any more
    for one in priors:
        hub.handle(one)
    return hub.clock_contradictions()


def test_a_wrong_clock_is_reported_with_its_stated_error_and_the_difference(hub: LiveHub, session: Session) -> None:
    others = clock_status(session, "cam0"), clock_status(session, "cam2", error_s=0.0005)
    (text,) = contradictions(hub, *others, clock_status(session, "cam1", off_s=1.3))
    assert text.startswith("cam1's clock reports synchronisation to 2 ms and cam")
    assert "the images show a difference of 1.3 s" in text
    for off_s in (1.3, -1.3):
        (of_two,) = contradictions(hub, others[0], clock_status(session, "cam1", off_s=off_s))
        text = (
            "cam1's clock reports synchronisation to 2 ms and cam0's to 2 ms, but the images show a difference of 1.3 s"
        )
        assert of_two.startswith(text), "the others are compared with the reference"
    (reference,) = contradictions(
        hub, clock_status(session, "cam0", off_s=40.0), others[1], clock_status(session, "cam1")
    )
    assert reference.startswith("cam0's clock"), "where two of three agree, the third is wrong"
    assert "the images show a difference of 40 s" in reference


def test_consistent_clocks_are_not_reported(hub: LiveHub, session: Session) -> None:
    right = [clock_status(session, name) for name in ("cam0", "cam1", "cam2")]
    assert contradictions(hub, *right) == []
    assert contradictions(hub, right[0], clock_status(session, "cam1", off_s=0.05)) == [], (
        "a camera's own delay may be that much"
    )
    assert contradictions(hub, right[0], clock_status(session, "cam1", off_s=1.3, error_s=1.5)) == [], (
        "within its stated error"
    )
    assert contradictions(hub, right[0], clock_status(session, "cam1", off_s=1.3, synchronised=False)) == [], "no prior"
    assert contradictions(hub, right[0], clock_status(session, "cam1", off_s=1.3, boot="boot1")) == [], (
        "another run than the calibrated one"
    )
    assert contradictions(hub, clock_status(session, "cam1", off_s=1.3)) == [], "no other camera to compare with"
    assert contradictions(LiveHub(SETTINGS), *right) == [], "nothing is known yet"


def regular_session(seed: int, period: float = 2.5, cameras: int = 2, unrelated: tuple[int, ...] = ()) -> Session:
    """Cameras that see an exactly periodic motion: lags a period apart fit equally well."""
    rng = np.random.default_rng(seed)
    harmonic = np.arange(1.0, 4.0)[:, None] * np.ones((1, 3))
    amplitude = rng.uniform(0.4, 1.0, (3, 3)) / harmonic
    path = Path(harmonic / period, rng.uniform(0.0, 2.0 * np.pi, (3, 3)), 1.4 * amplitude / amplitude.sum(axis=0))
    return simulate(seed, cameras, 20, path=path, ppm=20.0, unrelated=list(unrelated))


def hub_after(session: Session, *priors: pb.AgentStatus) -> LiveHub:
    """A hub that received the priors before its first calibration."""
    made = LiveHub(LiveSettings(interval_s=1e9))
    for one in priors:
        made.handle(one)
    for message in messages(session):
        made.handle(message)
    made.tick(0.0, final=True)
    return made


@pytest.mark.parametrize("seed", [900, 902])
def test_of_lags_that_are_ambiguous_by_periodic_motion_the_prior_selects_one_with_a_warning(seed: int) -> None:
    session = regular_session(seed)
    without_prior = hub_after(session)
    assert without_prior.calibration is None
    assert without_prior.refusal is not None, "the motion alone is ambiguous by periods"
    priors = clock_status(session, "cam0", off_s=0.02), clock_status(session, "cam1", off_s=-0.03)
    selected = hub_after(session, *priors).calibration
    assert selected is not None
    assert abs(session.clock_error("cam1", "cam0", selected.cameras["cam1"].time_map)) < 2e-3, (
        "as precise as from the images"
    )
    (warning,) = [text for text in selected.warnings if "external clock priors" in text]
    assert warning.startswith("cam0–cam1: the motion alone is consistent with several lags")


def test_a_prior_selects_also_beside_a_camera_that_does_not_see_the_motion() -> None:
    session = regular_session(900, cameras=3, unrelated=(2,))
    selected = hub_after(session, clock_status(session, "cam0"), clock_status(session, "cam1")).calibration
    assert selected is not None
    assert list(selected.cameras) == ["cam0", "cam1"]
    assert abs(session.clock_error("cam1", "cam0", selected.cameras["cam1"].time_map)) < 2e-3


@pytest.mark.parametrize(
    ("off_s", "error_s"),
    [(3.0, 0.002), (-1.2, 0.002), (0.0, 0.5)],
    ids=["no period", "half a period", "too imprecise to select"],
)
def test_a_prior_that_fits_none_or_all_of_the_lags_selects_none(off_s: float, error_s: float) -> None:
    session = regular_session(902)
    hub = hub_after(
        session, clock_status(session, "cam0", error_s=error_s), clock_status(session, "cam1", off_s, error_s)
    )
    assert hub.calibration is None
    assert hub.refusal is not None


@pytest.mark.parametrize("off_s", [3.0, -0.4, 0.0])
def test_where_the_images_determine_the_lag_no_prior_changes_it(session: Session, off_s: float) -> None:
    without_prior = hub_after(session).calibration
    priors = [clock_status(session, name, off_s=off_s * (name == "cam1")) for name in ("cam0", "cam1", "cam2")]
    with_priors = hub_after(session, *priors).calibration
    assert without_prior is not None
    assert with_priors is not None
    assert {n: c.time_map for n, c in with_priors.cameras.items()} == {
        n: c.time_map for n, c in without_prior.cameras.items()
    }
    assert with_priors.warnings == without_prior.warnings


def test_a_prior_of_another_run_of_the_agent_selects_nothing() -> None:
    session = regular_session(902)
    hub = hub_after(session, clock_status(session, "cam0"), clock_status(session, "cam1", boot="boot1"))
    assert hub.calibration is None


def test_a_prior_moves_no_estimate(hub: LiveHub, session: Session) -> None:
    assert hub.calibration is not None
    before = hub.calibration.cameras
    contradictions(hub, clock_status(session, "cam0"), clock_status(session, "cam1", off_s=1.3))
    hub.tick(2e6, final=True)
    for name, camera in hub.calibration.cameras.items():
        at = CameraTime(camera.lag_time)
        one, other = (found.time_map.reference_from_camera(at) for found in (camera, before[name]))
        assert abs(float(one) - float(other)) <= 0.2 * before[name].time_offset_std + 1e-6, "it starts from the last"


def test_the_hubs_status_reports_the_contradiction(hub: LiveHub, session: Session) -> None:
    contradictions(hub, clock_status(session, "cam0"), clock_status(session, "cam1", off_s=1.3))
    text = status_message(hub, "hub", "b", 0, []).message
    assert CONTRADICTION in text
    assert text.endswith("3 cameras calibrated")


def test_a_running_hub_receives_priors_from_the_cameras_statuses(session: Session) -> None:
    network = MemoryHub()
    with MemoryBus(network) as bus, MemoryBus(network) as own:
        statuses = bus.subscribe(STATUS)
        with running(lambda stop: run_hub(LiveHub(SETTINGS), own, "hub", stop)):
            topics = {"CameraInfo": CAMERA_INFO, "Observation": OBSERVATION}
            publishers = {}
            for message in messages(session):
                name = message.DESCRIPTOR.name, message.camera  # type: ignore[attr-defined]
                if name not in publishers:
                    publishers[name] = bus.publisher(topics[name[0]], name[1])
                publishers[name].put(message)
            for one in (clock_status(session, "cam0"), clock_status(session, "cam1", off_s=1.3)):
                bus.publisher(STATUS, one.agent).put(one)
            messages_seen: list[str] = []

            def reported() -> bool:
                messages_seen.extend(r.message.message for r in statuses.drain() if r.agent == "hub")
                return any(CONTRADICTION in text for text in messages_seen)

            assert eventually(reported, 60.0), messages_seen[-3:]
