"""Cameras split over hubs by their overlap: pairs across, messages, links and state for up to 100,000 cameras.

    python -m tests.bench.sharding [--cameras 1000,10000,100000] [--of-hub 176]

Two sites: a street, where a camera overlaps with those five before and after it, and a town, cameras anywhere on a
square that overlap with ten on average. Sizes of messages are those of this build; what a hub and a router carry comes
from `python -m tests.bench.scale`. Hashing: cameras to hubs without regard to overlap, as after a hub's death today.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from hub.distributed.factors.factor import RAW_CAPACITY
from hub.distributed.sharding import cut, partition
from protocols.messages import syncline_pb2 as pb
from protocols.topics import NODE_STATE, OBSERVATION, PREDICTION, TRACK
from protocols.validation.codec import encode
from tests.bench.logs import messages

_FPS, _EDGES, _CHECKPOINT = 30.0, 10, 5
_SESSIONS = 1000
Pairs = dict[tuple[str, str], float]


def street(count: int) -> tuple[list[str], Pairs]:
    """Cameras along a line."""
    names = [f"cam{number}" for number in range(count)]
    return names, {(names[a], names[a + k]): 1.0 for k in range(1, 6) for a in range(count - k)}


def town(count: int) -> tuple[list[str], Pairs]:
    """Cameras anywhere on a square."""
    at = np.random.default_rng(count).uniform(0, 1, (count, 2))
    names = [f"cam{number}" for number in range(count)]
    close = cKDTree(at).query_pairs(math.sqrt(_EDGES / math.pi / count), output_type="ndarray")
    return names, {(names[a], names[b]): 1.0 for a, b in close}


def node_bytes() -> tuple[int, int]:
    """Bytes of a node's state: without and with the factors of its edges."""
    state = pb.NodeState(schema_version=1, camera="cam12345", host="hub123", frame="cam0", sequence=10**6, settled=1000)
    state.rotation[:], state.position[:] = [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]
    bare = len(encode(state))
    for number in range(_EDGES):
        edge = state.edges.add(neighbour=f"cam{number + 12000}", count=1e5, chi2=1e5)
        edge.rotation[:], edge.centre[:] = [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]
        edge.hessian[:], edge.gradient[:] = [1e4] * 21, [1.0] * 6
    return bare, len(encode(state))


def row(site: str, names: Sequence[str], pairs: Pairs, of_hub: int) -> str:
    """One line of the table."""
    hubs = math.ceil(len(names) / of_hub)
    began = time.process_time()
    groups = partition(pairs, names, hubs)
    spent = time.process_time() - began
    hashed = np.random.default_rng(0).permutation(len(names))
    by_hash = cut(pairs, [[names[k] for k in hashed[number::hubs]] for number in range(hubs)])
    across = cut(pairs, groups)
    group = {name: number for number, members in enumerate(groups) for name in members}
    border = {name for a, b in pairs if group[a] != group[b] for name in (a, b)}
    neighbours: list[set[int]] = [set() for _ in groups]
    for a, b in pairs:
        if group[a] != group[b]:
            neighbours[group[a]].add(group[b])
            neighbours[group[b]].add(group[a])
    bare, full = node_bytes()
    size = len(encode(messages(1)[0]))
    # Of a camera at a border, its observations and its node's state go to other hubs, too.
    crossing = len(border) * (_FPS + NODE_STATE.rate_hz)
    megabits = 8e-6 * len(border) * (_FPS * size + NODE_STATE.rate_hz * (bare + (full - bare) / _CHECKPOINT))
    cells = (
        site, f"{len(names):,}", f"{hubs}", f"{max(map(len, groups))}", f"{across:,} of {len(pairs):,}",
        f"{100 * by_hash / len(pairs):.0f} %", f"{100 * len(border) / len(names):.0f} %",
        f"{max(map(len, neighbours))}", f"{len(names) * _FPS:,.0f}", f"{crossing:,.0f}", f"{megabits:,.0f}",
        f"{math.ceil(len(names) / _SESSIONS) + 1}", f"{spent:.1f}",
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Constants, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", default="1000,10000,100000")
    parser.add_argument("--of-hub", type=int, default=176, help="what a hub carries at 30 Hz with half a core")
    words = parser.parse_args()
    bare, full = node_bytes()
    print(f"observation of four detections: {len(encode(messages(1)[0]))} bytes, {OBSERVATION.rate_hz:g} Hz")
    print(f"a node's state: {bare} bytes, {NODE_STATE.rate_hz:g} Hz; each {_CHECKPOINT}th with factors: {full} bytes")
    print(f"tracks {TRACK.rate_hz:g} Hz a target, predictions {PREDICTION.rate_hz:g} Hz a hub")
    print(f"state of an edge: {8 * 32} bytes, while it begins {RAW_CAPACITY * 32} more\n")
    head = "site | cameras | hubs | largest | pairs across | hashed | at a border | hubs beside | obs/s | across/s"
    print(f"| {head} | Mbit/s across | routers | CPU s |\n|{'---|' * 13}")
    for count in (int(word) for word in words.cameras.split(",")):
        for site, make in (("street", street), ("town", town)):
            print(row(site, *make(count), words.of_hub), flush=True)


if __name__ == "__main__":
    main()
