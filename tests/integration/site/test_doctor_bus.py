"""`syncline doctor` on the bus: real routers on loopback, plain and with valid and invalid certificates."""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest

from deploy.site.doctor import agent
from protocols.bus.router import selftest
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig, TlsConfig
from protocols.bus.transport.session import open_session
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import OBSERVATION, STATUS
from tests.support.samples import eventually

pytest.importorskip("cryptography", reason="the extra `keys` is not installed: access rules are not tested")
from deploy.site.keys import issue, make_site
from tests.support.links import poisoned, through_a_link
from tests.support.threads import looping

SITE = "test"


def test_the_path_through_a_router() -> None:
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with Router(endpoint):
        found = agent.bus_path(config, SITE, "camera", "cam0")
        assert found.verdict == "ok", found
        assert "1 MB in" in found.text


def test_no_router() -> None:
    found = agent.bus_path(BusConfig(mode="client", connect=(free_endpoint(),)), SITE, "camera", "cam0")
    assert (found.verdict, found.exit_status) == ("fail", 3)
    assert "start one there" in found.remedy


def test_a_name_in_use_twice_and_a_site_without_a_hub_are_warned_of() -> None:
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with (
        Router(endpoint),
        open_bus("lab", config, timeout_s=5.0) as lab,
        open_bus("yard", config) as yard,
        ExitStack() as up,
    ):
        up.enter_context(lab.announce("hub", "hub", "boot-1"))
        up.enter_context(yard.announce("camera", "cam é", "boot-2"))
        eventually(lambda: len(selftest.agents_alive(config)) == 2)
        found = agent.others(config, "yard", "camera")
        assert found.verdict == "warn"
        assert 'no hub of site "yard" runs here, but one of site "lab"' in found.text
        assert 'site = "lab"' in found.remedy
        assert agent.others(config, "lab", "camera").text == "site lab: hub hub"
        up.enter_context(lab.announce("hub", "hub", "boot-3"))
        eventually(lambda: agent.others(config, "lab", "hub").verdict == "warn")
        assert "runs 2 times" in agent.others(config, "lab", "hub").text


def test_a_live_router_that_does_not_route() -> None:
    """A declaration with a `?` ends all routing in Zenoh 1.10.2; the router still accepts connections."""
    endpoint = free_endpoint()
    config = BusConfig(mode="client", connect=(endpoint,))
    with Router(endpoint):
        assert agent.bus_path(config, SITE, "camera", "cam0").verdict == "ok"
        hostile = through_a_link(endpoint, poisoned)
        poison = open_session(BusConfig(mode="client", connect=(hostile,)), timeout_s=5.0)
        poison.declare_publisher("camQ/observation")
        found = agent.bus_path(config, SITE, "camera", "cam0")
        assert (found.verdict, found.exit_status) == ("fail", 3)
        assert "relays no messages" in found.text
        assert "restart the router" in found.remedy


def test_a_path_that_drops_large_messages() -> None:
    """Like a tunnel with a smaller MTU without ICMP: small packets pass, full-size ones are dropped."""
    endpoint = free_endpoint()
    with Router(endpoint):
        narrow = through_a_link(endpoint, lambda data: data if len(data) < 20_000 else b"")
        found = agent.bus_path(BusConfig(mode="client", connect=(narrow,)), SITE, "camera", "cam0", 2.0)
    assert (found.verdict, "MTU" in found.remedy) == ("fail", True), found


@pytest.mark.parametrize(
    ("passes", "verdict", "remedy"),
    [
        ({1024: 0.001, 1_000_000: None}, "fail", "MTU"),
        ({1024: 0.4, 1_000_000: 1.0}, "warn", "a cable"),
    ],
)
def test_a_path_that_drops_all_messages(
    passes: dict[int, float | None], verdict: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trip(config: BusConfig, prefix: str, size: int = 0, timeout_s: float = 3.0) -> float | None:
        return passes[size]

    monkeypatch.setattr(selftest, "round_trip", trip)
    found = agent.bus_path(BusConfig(mode="client"), SITE, "hub", "hub")
    assert (found.verdict, remedy in found.remedy) == (verdict, True)


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, str]:
    """Certificates of a router, a camera and a hub; the router's endpoint."""
    folder = tmp_path / "keys"
    endpoint = free_endpoint().replace("tcp/", "tls/")
    make_site(folder, SITE)
    issue(folder, "router", "main", listen=[endpoint])
    issue(folder, "camera", "cam0", connect=[endpoint])
    issue(folder, "hub", "hub", connect=[endpoint])
    return folder, endpoint


def of(folder: Path, name: str) -> TlsConfig:
    own = folder / name
    return TlsConfig(ca=own / "ca.pem", certificate=own / "certificate.pem", key=own / "key.pem")


def secured(folder: Path, endpoint: str, *, rules: bool) -> Router:
    access = folder / "router-main" / "zenoh.json5" if rules else None
    return Router(config=BusConfig(mode="router", listen=(endpoint,), tls=of(folder, "router-main"), access=access))


def test_valid_certificates_and_access_rules(keys: tuple[Path, str]) -> None:
    folder, endpoint = keys
    camera = BusConfig(mode="client", connect=(endpoint,), tls=of(folder, "camera-cam0"))
    hub = BusConfig(mode="client", connect=(endpoint,), tls=of(folder, "hub-hub"))
    assert agent.certificates(camera, "camera", "cam0").verdict == "ok"
    with secured(folder, endpoint, rules=True):
        nobody = agent.bus_path(camera, SITE, "camera", "cam0")
        assert (nobody.verdict, "start a hub or recorder" in nobody.remedy) == ("fail", True)
        found = agent.bus_path(hub, SITE, "hub", "hub")
        assert found.verdict == "ok", found
        assert agent.access_rights(hub, SITE, "hub", "hub").verdict == "ok"
        with open_bus(SITE, hub, timeout_s=5.0) as bus:
            bus.subscribe(OBSERVATION)
            publisher = bus.publisher(STATUS, "hub")
            publisher.put(pb.AgentStatus(schema_version=1, agent="hub", role="hub", boot_id="b", state="running"))
            assert agent.bus_path(camera, SITE, "camera", "cam0").verdict == "ok"
            assert agent.access_rights(camera, SITE, "camera", "cam0", seconds=0.7).verdict == "ok"


def test_a_router_without_rules_is_detected(keys: tuple[Path, str]) -> None:
    folder, endpoint = keys
    camera = BusConfig(mode="client", connect=(endpoint,), tls=of(folder, "camera-cam0"))
    hub = BusConfig(mode="client", connect=(endpoint,), tls=of(folder, "hub-hub"))
    with secured(folder, endpoint, rules=False), open_bus(SITE, hub, timeout_s=5.0) as bus:
        publisher = bus.publisher(STATUS, "hub")
        publisher.put(pb.AgentStatus(schema_version=1, agent="hub", role="hub", boot_id="b", state="running"))
        speaks = agent.access_rights(hub, SITE, "hub", "hub")
        assert (speaks.verdict, "publish for others" in speaks.text) == ("fail", True)
        assert "zenoh.json5" in speaks.remedy

        speech = pb.AgentStatus(schema_version=1, agent="hub", role="hub", boot_id="b", state="running")
        with looping(lambda: publisher.put(speech), 0.1):
            hears = agent.access_rights(camera, SITE, "camera", "cam0", seconds=3.0)
        assert (hears.verdict, "receives messages that it may not receive" in hears.text) == ("fail", True)


def test_a_foreign_an_expiring_and_a_readable_certificate(keys: tuple[Path, str]) -> None:
    folder, endpoint = keys
    config = BusConfig(mode="client", connect=(endpoint,), tls=of(folder, "camera-cam0"))
    anothers = agent.certificates(config, "camera", "cam1")
    assert (anothers.verdict, anothers.exit_status) == ("fail", 2)
    assert "--id cam1" in anothers.remedy
    issue(folder, "camera", "cam0", days=2.0)
    assert "renew with `syncline keys issue`" in agent.certificates(config, "camera", "cam0").remedy
    (folder / "camera-cam0/key.pem").chmod(0o644)
    assert "chmod 600" in agent.certificates(config, "camera", "cam0").remedy
    shutil.rmtree(folder / "camera-cam0")
    gone = agent.certificates(config, "camera", "cam0")
    assert (gone.verdict, "syncline keys issue" in gone.remedy) == ("fail", True)
