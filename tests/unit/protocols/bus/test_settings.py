"""What every Zenoh session is opened with, and where it listens."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from deploy.agents.startup_checks import check_startup
from deploy.config.agents import HubConfig
from deploy.config.file import load
from protocols.bus.settings import BusConfig, TlsConfig, is_loopback, unprotected_listeners
from protocols.bus.transport.session import LEASE_MS, MAX_MESSAGE_SIZE, _settings
from protocols.core.errors import InputError
from protocols.topics import OBSERVATION, STATUS, cache_size


def opened_with(config: BusConfig, key: str) -> Any:
    return json.loads(_settings(config, *config.endpoints(), 100).get_json(key))


@pytest.mark.parametrize("mode", ["peer", "client", "router"])
def test_sizes_sessions_leases_and_shared_memory_are_bounded_in_every_mode(mode: Any) -> None:
    config = BusConfig(mode=mode, max_sessions=17)
    assert opened_with(config, "transport/shared_memory/enabled") is False
    assert opened_with(config, "transport/link/rx/max_message_size") == MAX_MESSAGE_SIZE
    assert opened_with(config, "transport/link/tx/lease") == LEASE_MS < 2000
    assert opened_with(config, "transport/unicast/max_sessions") == 17
    assert opened_with(config, "scouting/multicast/enabled") is False


@pytest.mark.parametrize("mode", ["peer", "client", "router"])
def test_nothing_listens_beyond_loopback_unless_told(mode: Any) -> None:
    config = BusConfig(mode=mode)
    assert all(is_loopback(endpoint) for endpoint in config.endpoints()[1])
    assert unprotected_listeners(config) == ()
    assert all(is_loopback(one) for one in opened_with(config, "listen/endpoints") or [])


def test_an_open_door_is_known_as_one() -> None:
    assert unprotected_listeners(BusConfig(mode="router", listen=("tcp/0.0.0.0:7447",))) == ("tcp/0.0.0.0:7447",)
    assert unprotected_listeners(BusConfig(multicast=True)) != ()


def test_a_cache_holds_the_configured_outage_and_half_as_much_again() -> None:
    assert cache_size(OBSERVATION, 30.0, 60.0) >= 30 * 60 * 1.5
    assert cache_size(OBSERVATION, 200.0, 4.0) == 200 * 4 * 1.5
    assert cache_size(STATUS, 30.0, 60.0) == 1


def test_secrets_are_paths(tmp_path: Path) -> None:
    """A key written into the configuration itself is not taken for one."""
    file = tmp_path / "hub.toml"
    pem = "-----BEGIN PRIVATE KEY-----"
    table = f'[bus.tls]\nca = "ca.pem"\ncertificate = "c.pem"\nkey = """{pem}\nAAAA"""\n'
    file.write_text(f'[bus]\nmode = "client"\nconnect = ["tls/127.0.0.1:7447"]\n{table}', encoding="utf-8")
    settings = load(file, HubConfig)
    with pytest.raises(InputError, match="cannot be read"):
        check_startup(settings)
    assert set(TlsConfig.__annotations__) == {"ca", "certificate", "key"}
