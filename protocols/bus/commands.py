"""Receives operator commands for one agent from the bus, without duplicates."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

from protocols.bus.base import Bus
from protocols.messages import syncline_pb2 as pb
from protocols.topics import COMMAND

_DUPLICATE_WINDOW = 1024  # commands: a click a second for a quarter of an hour


class CommandSubscription:
    """The commands addressed to one run of one agent.

    agent, boot: its id and boot id; commands to an earlier run are ignored by a later one. actions: the actions that
    it supports; others are ignored.
    """

    def __init__(self, bus: Bus, agent: str, boot: str, actions: Collection[str]) -> None:
        self._subscription = bus.subscribe(COMMAND)
        self._agent, self._boot, self._actions = agent, boot, frozenset(actions)
        self._known: deque[tuple[str, str, int]] = deque(maxlen=_DUPLICATE_WINDOW)

    def take(self) -> list[str]:
        """The actions requested since the last call, in order."""
        actions = []
        for received in self._subscription.drain():
            command = received.message
            assert isinstance(command, pb.Command)
            identity = (command.sender, command.boot_id, command.sequence)
            if (command.agent, command.agent_boot) != (self._agent, self._boot) or identity in self._known:
                continue
            self._known.append(identity)
            if command.action in self._actions:
                actions.append(command.action)
        return actions

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()
