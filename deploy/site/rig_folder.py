"""A rig as a folder: rig.toml, one TOML an agent, fleet.toml; with simulated cameras in place of the real ones.

An agent's role is told by its file's name: router*.toml, recorder*.toml, hub*.toml, uav*.toml; any other is a camera.
"""

from __future__ import annotations

import socket
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tomli_w
from msgspec import Meta

from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, SimulatedConfig
from deploy.config.file import effective_toml, load
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError
from protocols.session.rig import Rig, read_rig

SHIPPED = Path(__file__).parents[1] / "examples" / "rigs"
ROLES = ("router", "recorder", "hub", "camera", "uav")
"""In the order in which they are started; they are stopped the other way round."""
_NOT_AGENTS = {"rig.toml", "fleet.toml"}
_FLIGHT_S = 600.0


class World(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """fleet.toml, [simulated]: the world that stands in for the real one. width [px], fps [Hz]: of every camera."""

    scene: str = "marker"
    seed: Annotated[int, Meta(ge=0)] = 1
    width: Annotated[int, Meta(ge=64, le=7680)] | None = None
    fps: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None


class FleetFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """fleet.toml."""

    simulated: World = msgspec.field(default_factory=World)


@dataclass(frozen=True, slots=True)
class Agent:
    """One agent of a rig. file: its configuration; config: the same, read."""

    name: str
    role: str
    file: Path
    config: Any


@dataclass(frozen=True, slots=True)
class RigFolder:
    """A whole rig. rig: what rig.toml says; None without one."""

    name: str
    folder: Path
    agents: tuple[Agent, ...]
    rig: Rig | None
    world: World

    def of(self, role: str) -> tuple[Agent, ...]:
        """The agents of one role."""
        return tuple(agent for agent in self.agents if agent.role == role)


def role_of(file: Path) -> str:
    """The role that a file's name tells."""
    return next((role for role in ROLES if role != "camera" and file.stem.startswith(role)), "camera")


def kind_of(role: str) -> type[msgspec.Struct]:
    """The configuration struct of a role; InputError for one that this version does not have."""
    from deploy.site.install.plan import config_kind

    return config_kind(role)


def find_rig(rig: str) -> Path:
    """The folder of a rig: a path, or the name of one that is shipped. Raises InputError."""
    if Path(rig).is_dir():
        return Path(rig)
    if "/" not in rig and (SHIPPED / rig).is_dir():
        return SHIPPED / rig
    names = ", ".join(sorted(path.name for path in SHIPPED.iterdir() if (path / "README.md").is_file()))
    raise InputError(f"there is no rig {rig!r}", remedy=f"give a folder, or one of {names}")


def read_rig_folder(folder: Path) -> RigFolder:
    """Read and check everything in it. Raises InputError for the first thing that is wrong."""
    files = sorted(path for path in folder.glob("*.toml") if path.name not in _NOT_AGENTS)
    if not files:
        raise InputError("no agents in this rig", file=folder, remedy="add one TOML file an agent: cam0.toml, hub.toml")
    agents: dict[str, Agent] = {}
    for file in files:
        role = role_of(file)
        config = load(file, kind_of(role))
        name = getattr(config, "id", file.stem)
        if name in agents:
            raise InputError(f"id {name!r} is also that of {agents[name].file.name}", file=file, remedy="rename one")
        agents[name] = Agent(name, role, file, config)
    sites = {agent.config.site: agent.file for agent in agents.values()}
    if len(sites) > 1:
        told = ", ".join(f"{file.name}: {site}" for site, file in sites.items())
        raise InputError(f"agents of several sites ({told})", file=folder, remedy="give all the same site")
    rig = read_rig(folder / "rig.toml") if (folder / "rig.toml").is_file() else None
    fleet = load(folder / "fleet.toml", FleetFile) if (folder / "fleet.toml").is_file() else FleetFile()
    for agent in agents.values():
        if agent.role == "camera" and agent.config.rig is not None:
            known = read_rig(agent.config.rig)
            if agent.name not in known.cameras:
                what = f"rig.toml has no camera {agent.name!r}"
                raise InputError(what, file=agent.file, remedy=f"add [{agent.name}]")
    ordered = sorted(agents.values(), key=lambda agent: (ROLES.index(agent.role), agent.name))
    return RigFolder(folder.resolve().name, folder, tuple(ordered), rig, fleet.simulated)


def prepare(rig: RigFolder, out: Path, *, simulated: bool, endpoint: str | None) -> tuple[Agent, ...]:
    """Write what each agent runs with to OUT/config, and return the agents with those files.

    What hubs and recorders write goes below ``out``. simulated: cameras film the rig's stand-in world through lenses
    of their own, and rig.toml is that world's. endpoint: where all meet instead of what their files say; None = as
    they say.
    """
    folder = out / "config"
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [agent.name for agent in rig.of("camera")]
    began = time.time()
    if simulated and cameras:
        (folder / "rig.toml").write_text(tomli_w.dumps(_simulated_rig(rig, cameras)), encoding="utf-8")
    agents = []
    for agent in rig.agents:
        config = agent.config
        if endpoint is not None:
            bus = BusConfig(mode="router", listen=(endpoint,)) if agent.role == "router" else client(endpoint)
            config = msgspec.structs.replace(config, bus=bus)
        if isinstance(config, HubConfig | RecorderConfig):
            config = msgspec.structs.replace(config, out=_out(agent, out))
        if simulated and isinstance(config, CameraConfig):
            config = _simulated_camera(config, rig.world, cameras, began, folder)
        if simulated and agent.role == "uav":
            config = _simulated_flight(config, rig.world, began)
        if simulated and isinstance(config, HubConfig) and config.rig is not None:
            config = msgspec.structs.replace(config, rig=folder / "rig.toml")
        file = folder / f"{agent.name}.toml"
        file.write_text(effective_toml(config), encoding="utf-8")
        agents.append(replace(agent, file=file, config=config))
    return tuple(agents)


def client(endpoint: str) -> BusConfig:
    """A client of one router."""
    return BusConfig(mode="client", connect=(endpoint,))


def _out(agent: Agent, out: Path) -> Path:
    given = tomllib.loads(agent.file.read_text(encoding="utf-8")).get("out")
    default = "recordings" if agent.role == "recorder" else agent.name
    place = Path(given or default).expanduser()
    return place if place.is_absolute() else out.resolve() / place


def _simulated_camera(
    config: CameraConfig, world: World, cameras: Sequence[str], began: float, folder: Path
) -> CameraConfig:
    stand_in = SimulatedConfig(
        scene=world.scene,
        seed=world.seed,
        cameras=max(len(cameras), 2),
        start_unix_s=began,
        camera=f"cam{cameras.index(config.id)}",
        width=world.width,
        fps=world.fps,
    )
    rig = None if config.rig is None else folder / "rig.toml"
    return msgspec.structs.replace(config, driver="simulated", simulated=stand_in, video=None, oak=None, rig=rig)


def _simulated_flight(config: Any, world: World, began: float) -> Any:
    """A UAV agent over the simulated town, with an autopilot on a port of its own."""
    from deploy.config.uav import FlightConfig, MavlinkConfig

    autopilot = f"127.0.0.1:{_free_port()}"
    flight = FlightConfig(
        autopilot=autopilot, seed=world.seed, seconds=_FLIGHT_S, gimbal=config.mount == "gimbal", start_unix_s=began
    )
    link = MavlinkConfig(url=f"udpout:{autopilot}")
    return msgspec.structs.replace(
        config, driver="simulated", simulated=flight, video=None, oak=None, rig=None, mavlink=link, video_out=None
    )


def _simulated_rig(rig: RigFolder, cameras: Sequence[str]) -> dict[str, Any]:
    """rig.toml of the stand-in world: its lenses, and of the rig's distances those that it has."""
    from edge import scenes
    from edge.scenes.common.scaled import scaled

    scene = scaled(scenes.get(rig.world.scene, rig.world.seed, max(len(cameras), 2)), rig.world.width, rig.world.fps)
    where = {name: scene.cameras[index] for index, name in enumerate(cameras)}
    tables: dict[str, Any] = {
        name: {
            "name": name,
            "size": [camera.intrinsics.width, camera.intrinsics.height],
            "fps": camera.fps,
            "matrix": camera.intrinsics.matrix.tolist(),
            "distortions": camera.intrinsics.distortions.tolist(),
        }
        for name, camera in where.items()
    }
    metadata: dict[str, Any] = {"name": f"{rig.name}, simulated", "units": "m"}
    wanted = {frozenset((a, b)) for a, b, _ in (() if rig.rig is None else rig.rig.distances)}
    metadata["distances"] = [
        [a, b, float(np.linalg.norm(where[a].pose.position - where[b].pose.position))]
        for a, b in combinations(cameras, 2)
        if frozenset((a, b)) in wanted
    ]
    return {"metadata": metadata, **tables}


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
