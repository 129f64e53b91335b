"""Authentication and access control over real TLS sessions, and how soon the operator gets which report."""

from __future__ import annotations

import json
import socket
import ssl
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from deploy.cli import run
from deploy.site import keys
from deploy.site.keys_check import check_site, tls_of
from protocols.bus.base import Publisher
from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.security.access import access_rules
from protocols.bus.security.tls import refusal_reason
from protocols.bus.settings import BusConfig, split_endpoint
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.topics import OBSERVATION
from tests.faults.matrix import measured
from tests.faults.processes import ROOT, Process, wait_until
from tests.support.receiving import collect, sequences
from tests.support.samples import observation


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with a router, a hub, two cameras, a drone and a view."""
    folder = tmp_path_factory.mktemp("keys") / "keys"
    keys.make_site(folder, "yard")
    for role, agent in (
        ("router", "r0"),
        ("hub", "hub"),
        ("camera", "cam0"),
        ("camera", "cam1"),
        ("uav", "d0"),
        ("view", "v0"),
    ):
        keys.issue(folder, role, agent)
    return folder


def camera_config(folder: Path, tls: Path, endpoint: str, agent: str = "cam0") -> Path:
    """A camera agent's configuration with the certificate in ``tls``; plain where the endpoint is."""
    lines = [f'id = "{agent}"', 'site = "yard"', "[bus]", 'mode = "client"', f'connect = ["{endpoint}"]']
    if endpoint.startswith("tls/"):
        lines += ["[bus.tls]", *(f'{what} = "{tls / name}"' for what, name in FILES.items())]
    file = folder / f"{agent}.toml"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


FILES = {"ca": keys.CA_FILE, "certificate": keys.CERTIFICATE_FILE, "key": keys.KEY_FILE}


def test_the_self_test_finds_every_rule_kept(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    findings = check_site(site)
    wrong = [finding for finding in findings if finding.wanted != finding.found]
    measured("what each certificate may do", "deny by default", f"{len(findings)} tried, {len(wrong)} wrong")
    assert wrong == []
    assert len(findings) > 60
    allowed = {(finding.who, finding.what) for finding in findings if finding.found}
    orders = {who for who, what in allowed if what.endswith(" command")}
    records = {who for who, what in allowed if what.endswith(" target_command")}
    assert orders == {"view v0"}, "what agents obey: only a view's own"
    assert records == {"uav d0"}, "what a drone received by radio: only its own record of it"


def test_a_revoked_certificate_may_do_nothing_and_its_successor_everything(site: Path, tmp_path: Path) -> None:
    """Through a router that runs all the time."""
    import shutil

    copy = tmp_path / "keys"
    shutil.copytree(site, copy)
    stolen = tmp_path / "stolen"
    shutil.copytree(copy / "camera-cam0", stolen)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    keys.issue(copy, "router", "r0", listen=[endpoint])

    def client(folder: Path) -> BusConfig:
        return BusConfig(mode="client", connect=(endpoint,), tls=tls_of(folder))

    with Process("-m", "deploy", "router", str(copy / "router-r0" / keys.ROUTER_FILE)) as process:
        assert process.line().startswith("relays at")
        with (
            open_bus("yard", client(copy / "hub-hub"), timeout_s=10.0) as hub,
            open_bus("yard", client(stolen), timeout_s=10.0) as thief,
        ):
            subscription = hub.subscribe(OBSERVATION)
            stealing, number = thief.publisher(OBSERVATION, "cam0"), 0

            def is_received(publisher: Publisher) -> bool:
                nonlocal number
                publisher.put(observation("cam0", number))
                number += 1
                time.sleep(0.05)
                return bool(subscription.drain())

            wait_until(lambda: is_received(stealing))
            began = time.monotonic()
            assert run(["keys", "revoke", str(copy), "--role", "camera", "--id", "cam0"]) == 0
            assert process.line().startswith("relays at"), "the router has taken up the new rules"
            seconds = time.monotonic() - began
            keys.issue(copy, "camera", "cam0")
            assert process.line().startswith("relays at")
            with open_bus("yard", client(copy / "camera-cam0"), timeout_s=10.0) as camera:
                own = camera.publisher(OBSERVATION, "cam0")
                wait_until(lambda: is_received(own))
            while subscription.drain():
                time.sleep(0.5)
            assert not any(is_received(stealing) for _ in range(40))
    tried = [finding for finding in check_site(copy) if finding.who == "camera cam0 (revoked)"]
    assert len(tried) > 20
    assert [finding.what for finding in tried if finding.found] == ["connects"]
    assert all(finding.wanted == finding.found for finding in tried)
    measured(
        "revoked certificate",
        "may do nothing",
        f"nothing of {len(tried) - 1} tried; {seconds:.2f} s from `keys revoke` to a running router's new rules",
    )


def test_revoking_is_idempotent_and_a_damaged_authority_is_reported(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    copy = tmp_path / "keys"
    shutil.copytree(site, copy)
    words = ["keys", "revoke", str(copy), "--role", "camera", "--id", "cam1"]
    assert run(words) == run(words) == 0
    keys.issue(copy, "camera", "cam1")
    rules = (copy / "router-r0" / keys.ZENOH_FILE).read_text(encoding="utf-8")
    assert '"camera.cam1.2"' in rules
    assert '"camera.cam1"' not in rules
    site_file = copy / keys.SITE_FILE
    site_file.write_text(site_file.read_text(encoding="utf-8").replace('"generation": 2', '"generation": "x"'))
    capsys.readouterr()
    assert run(words) == 2
    text = capsys.readouterr().err
    assert "is not what `syncline keys` writes" in text
    assert len(text.strip().splitlines()) == 1


def test_the_self_test_finds_a_rule_that_is_too_wide(site: Path, tmp_path: Path) -> None:
    """Else it would find nothing whatever the rules are."""
    import shutil

    copy = tmp_path / "keys"
    shutil.copytree(site, copy)
    file = copy / "router-r0" / keys.ZENOH_FILE
    document = json.loads(file.read_text(encoding="utf-8"))
    for rule in document["access_control"]["rules"]:
        if rule["id"] == "own-camera.cam0":
            rule["key_exprs"] = ["syncline/yard/**"]
    file.write_text(json.dumps(document), encoding="utf-8")
    wrong = {(f.who, f.what) for f in check_site(copy) if f.wanted != f.found}
    assert ("camera cam0", "says another's observation") in wrong


def test_observations_go_through_with_certificates_and_late_joiners_get_their_history(site: Path) -> None:
    endpoint = free_endpoint().replace("tcp/", "tls/")
    place = site / "router-r0"
    config = BusConfig(mode="router", listen=(endpoint,), tls=tls_of(place), access=place / keys.ZENOH_FILE)

    def client(name: str) -> BusConfig:
        return BusConfig(mode="client", connect=(endpoint,), tls=tls_of(site / name))

    with (
        Router(config=config),
        open_bus("yard", client("camera-cam0"), timeout_s=5.0) as camera,
        open_bus("yard", client("hub-hub"), timeout_s=5.0) as hub,
    ):
        publisher = camera.publisher(OBSERVATION, "cam0")
        with camera.announce("camera", "cam0", "boot-1"):
            for index in range(50):
                publisher.put(observation("cam0", index))
            subscription = hub.subscribe(OBSERVATION)
            assert sequences(collect(subscription, 50)) == list(range(50))
            assert publisher.wait_matched(5.0)
            watch = hub.watch_agents()
            seen = []
            wait_until(lambda: seen.extend(watch.drain()) or seen)
            assert seen[0].agent == "cam0"


@pytest.mark.parametrize("what", ["plain TCP", "wrong authority", "expired", "another's", "no certificate"])
def test_a_rejected_client_gets_the_reason_within_a_second(site: Path, tmp_path: Path, what: str) -> None:
    endpoint = free_endpoint().replace("tcp/", "tls/")
    place = site / "router-r0"
    config = BusConfig(mode="router", listen=(endpoint,), tls=tls_of(place), access=place / keys.ZENOH_FILE)
    folder, where = site / "camera-cam0", endpoint
    words = {
        "plain TCP": "it wants certificates, and this connection is plain TCP",
        "wrong authority": "it does not know who signed this certificate",
        "expired": "the certificate expired 1.0 days ago",
        "another's": "the certificate is 'camera.cam1''s, this is camera 'cam0'",
        "no certificate": "bus.tls: ca cannot be read: No such file",
    }[what]
    if what == "plain TCP":
        where = endpoint.replace("tls/", "tcp/")
    elif what == "wrong authority":
        keys.make_site(tmp_path / "other", "elsewhere")
        folder = keys.issue(tmp_path / "other", "camera", "cam0").folder
        (folder / keys.CA_FILE).write_bytes((site / keys.CA_FILE).read_bytes())
    elif what == "expired":
        folder = tmp_path / "expired"
        folder.mkdir()
        now = datetime.now(UTC)
        keys.sign(site, folder, "camera.cam0", now - timedelta(days=2), now - timedelta(days=1), ())
    elif what == "another's":
        folder = site / "camera-cam1"
    else:
        folder = tmp_path / "nothing"
    agent = camera_config(tmp_path, folder, where)
    with Router(config=config):
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "deploy", "camera", str(agent)],
            capture_output=True, text=True, timeout=20.0, check=False, cwd=ROOT,
        )  # fmt: skip
        seconds = time.monotonic() - began
        if what == "expired":
            refused = refusal_reason(endpoint, tls_of(folder))
            assert "expired" in refused, "the router itself turns it away too"
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    measured(
        f"certificate: {what}",
        "refused ≤ 1 s with the reason",
        f"exit 2 after {seconds:.2f} s: {words}",
        seconds <= 1.0,
    )


def test_a_client_without_a_certificate_is_rejected_by_the_router(site: Path) -> None:
    endpoint = free_endpoint().replace("tcp/", "tls/")
    place = site / "router-r0"
    config = BusConfig(mode="router", listen=(endpoint,), tls=tls_of(place), access=place / keys.ZENOH_FILE)
    with Router(config=config):
        _, host, port = split_endpoint(endpoint)
        context = ssl.create_default_context(cafile=site / keys.CA_FILE)
        began = time.monotonic()
        raw = socket.create_connection((host, port), timeout=3.0)
        with (
            pytest.raises((ssl.SSLError, OSError)) as error,
            raw,
            context.wrap_socket(raw, server_hostname=host) as tls,
        ):
            tls.recv(1)
        seconds = time.monotonic() - began
    assert "CERTIFICATE_REQUIRED" in str(error.value)
    measured(
        "certificate: none in the handshake", "refused ≤ 1 s", f"{seconds:.2f} s: certificate required", seconds <= 1.0
    )


def test_an_agent_without_a_rule_reports_that_it_has_no_subscriber(site: Path, tmp_path: Path) -> None:
    """A denied put returns normally: the agent's status line says that nobody is subscribed."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    place = site / "router-r0"
    rules = tmp_path / "rules.json5"
    named = [("router", "r0"), ("hub", "hub")]
    rules.write_text(json.dumps({"access_control": access_rules("yard", named)}), encoding="utf-8")
    config = BusConfig(mode="router", listen=(endpoint,), tls=tls_of(place), access=rules)
    agent = camera_config(tmp_path, site / "camera-cam0", endpoint)
    errors = tmp_path / "errors.txt"
    hub = BusConfig(mode="client", connect=(endpoint,), tls=tls_of(site / "hub-hub"))
    with Router(config=config), open_bus("yard", hub, timeout_s=5.0) as bus:
        subscription = bus.subscribe(OBSERVATION)
        with Process("-m", "deploy", "camera", str(agent), stderr=errors):
            wait_until(lambda: "no subscriber" in errors.read_text(encoding="utf-8"))
            assert subscription.drain() == []
    text = errors.read_text(encoding="utf-8")
    assert "access rules" in text
    measured("wrong access rules", "refused, the reason reaches the operator", "status line: no subscriber")


def test_keys_are_private_and_rules_deny(site: Path) -> None:
    for key in site.glob("**/*key.pem"):
        assert key.stat().st_mode & 0o777 == 0o600, key
    document = json.loads((site / "router-r0" / keys.ZENOH_FILE).read_text(encoding="utf-8"))
    assert document["access_control"]["default_permission"] == "deny"
    assert document["transport"]["link"]["tls"]["enable_mtls"] is True


def test_a_key_that_others_may_read_is_refused(site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import shutil

    folder = tmp_path / "camera-cam0"
    shutil.copytree(site / "camera-cam0", folder)
    (folder / keys.KEY_FILE).chmod(0o644)
    config = camera_config(tmp_path, folder, "tls/127.0.0.1:7447")
    assert run(["camera", str(config)]) == 2
    assert "others may read this key; chmod 600" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["init", "{there}", "--site", "yard"], "there is an authority here already"),
        (["init", "{new}", "--site", "Yard!"], "site 'Yard!' is not usable"),
        (["issue", "{new}", "--role", "camera", "--id", "cam0"], "holds no authority"),
        (["issue", "{there}", "--role", "camera", "--id", "cam?"], "id 'cam?' is not usable"),
        (["issue", "{there}", "--role", "camera", "--id", "c" * 60], "too long for a certificate"),
        (["issue", "{there}", "--role", "camera", "--id", "cam0", "--days", "0"], "no lifetime for a certificate"),
        (["issue", "{there}", "--role", "router", "--id", "r9", "--listen", "http://x"], "is not an endpoint"),
        (["check", "{new}"], "holds no authority"),
        (["revoke", "{new}", "--role", "camera", "--id", "cam0"], "holds no authority"),
        (["revoke", "{there}", "--role", "camera", "--id", "cam7"], "camera 'cam7' has no certificate"),
    ],
)
def test_wrong_usage_is_reported_in_one_line(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], expected: str
) -> None:
    places = {"there": str(site), "new": str(tmp_path / "new")}
    assert run(["keys", *(word.format(**places) for word in words)]) == 2
    text = capsys.readouterr().err
    assert expected in text
    assert len(text.strip().splitlines()) == 1
