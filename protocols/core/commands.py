"""What a person asks an agent for through the bus, each thing once."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

from protocols.bus.base import Bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import COMMAND

_REMEMBERED = 1024


class Orders:
    """The commands that are meant for one run of one agent.

    agent, boot: its id and boot id: what was asked of an earlier run is not obeyed by a later one. actions: those that
    it can do; others are ignored.
    """

    def __init__(self, bus: Bus, agent: str, boot: str, actions: Collection[str]) -> None:
        self._subscription = bus.subscribe(COMMAND)
        self._agent, self._boot, self._actions = agent, boot, frozenset(actions)
        self._known: deque[tuple[str, str, int]] = deque(maxlen=_REMEMBERED)

    def take(self) -> list[str]:
        """The actions that were asked for since the last call, in order."""
        asked = []
        for received in self._subscription.drain():
            command = received.message
            assert isinstance(command, pb.Command)
            identity = (command.sender, command.boot_id, command.sequence)
            if (command.agent, command.agent_boot) != (self._agent, self._boot) or identity in self._known:
                continue
            self._known.append(identity)
            if command.action in self._actions:
                asked.append(command.action)
        return asked

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()
