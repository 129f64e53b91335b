"""A client that lost its router says so: the hub's status is degraded within seconds."""

from __future__ import annotations

from protocols.bus.router.zenoh_router import Router, free_endpoint
from protocols.bus.settings import BusConfig
from protocols.bus.transport.memory import MemoryBus, MemoryHub
from protocols.bus.transport.zenoh_bus import open_bus
from tests.support.samples import eventually


def test_a_client_knows_whether_it_reaches_its_router() -> None:
    endpoint = free_endpoint()
    router = Router(endpoint)
    router.__enter__()
    with open_bus("local", BusConfig(mode="client", connect=(endpoint,)), timeout_s=10.0) as bus:
        assert eventually(bus.connected)
        router.__exit__(None, None, None)
        assert eventually(lambda: not bus.connected())


def test_others_are_connected_while_they_are_open() -> None:
    with open_bus("local", BusConfig(multicast=False)) as peer:
        assert peer.connected()
    with open_bus("local", BusConfig(connect=(free_endpoint(),))) as misled:
        assert not misled.connected(), "the address is another's, or wrong"
    with MemoryBus(MemoryHub()) as memory:
        assert memory.connected()
    assert not memory.connected()
