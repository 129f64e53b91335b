"""A rig as a folder: rig.toml, one TOML file per agent, fleet.toml; optionally with simulated cameras.

An agent's role follows from its file's name: router*.toml, recorder*.toml, hub*.toml, uav*.toml; any other is a camera.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tomli_w
from msgspec import Meta

from deploy.agents.processes import free_udp_port
from deploy.config.agents import CameraConfig, HubConfig, RecorderConfig, SimulatedConfig
from deploy.config.file import effective_toml, load
from deploy.site.install.plan import config_type
from protocols.bus.settings import BusConfig
from protocols.core.errors import InputError
from protocols.core.files import read_toml
from protocols.session.rig import Rig, read_rig

SHIPPED = Path(__file__).parents[1] / "examples" / "rigs"
ROLES = ("router", "recorder", "hub", "camera", "uav")
"""Roles in start order; they are stopped in reverse order."""
_NOT_AGENTS = {"rig.toml", "fleet.toml"}
_FLIGHT_DURATION_S = 600.0  # of a simulated flight in a fleet without --seconds


class SimulatedWorldConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """fleet.toml, [simulated]: the simulated scene for `--simulated`. width [px], fps [Hz]: of every camera."""

    scene: str = "marker"
    seed: Annotated[int, Meta(ge=0)] = 1
    width: Annotated[int, Meta(ge=64, le=7680)] | None = None
    fps: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None


class FleetFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Schema of fleet.toml."""

    simulated: SimulatedWorldConfig = msgspec.field(default_factory=SimulatedWorldConfig)


@dataclass(frozen=True, slots=True)
class Agent:
    """One agent of a rig. file: its configuration file; config: its parsed configuration."""

    name: str
    role: str
    file: Path
    config: Any


@dataclass(frozen=True, slots=True)
class RigFolder:
    """A whole rig. rig: the content of rig.toml; None without one. world: the simulated scene for `--simulated`."""

    name: str
    folder: Path
    agents: tuple[Agent, ...]
    rig: Rig | None
    world: SimulatedWorldConfig

    def of(self, role: str) -> tuple[Agent, ...]:
        """The agents of one role."""
        return tuple(agent for agent in self.agents if agent.role == role)


def role_of(file: Path) -> str:
    """The role that follows from a file's name."""
    return next((role for role in ROLES if role != "camera" and file.stem.startswith(role)), "camera")


def find_rig(rig: str) -> Path:
    """The folder of a rig: a path, or the name of a shipped rig. Raises InputError."""
    if Path(rig).is_dir():
        return Path(rig)
    if "/" not in rig and (SHIPPED / rig).is_dir():
        return SHIPPED / rig
    names = ", ".join(sorted(path.name for path in SHIPPED.iterdir() if (path / "README.md").is_file()))
    raise InputError(f"there is no rig {rig!r}", remedy=f"give a folder, or one of {names}")


def read_rig_folder(folder: Path) -> RigFolder:
    """Read and check all files of a rig. Raises InputError for the first error."""
    files = sorted(path for path in folder.glob("*.toml") if path.name not in _NOT_AGENTS)
    if not files:
        raise InputError(
            "no agents in this rig", file=folder, remedy="add one TOML file per agent: cam0.toml, hub.toml"
        )
    agents: dict[str, Agent] = {}
    for file in files:
        role = role_of(file)
        config = load(file, config_type(role))
        name = getattr(config, "id", file.stem)
        if name in agents:
            raise InputError(f"id {name!r} is also that of {agents[name].file.name}", file=file, remedy="rename one")
        agents[name] = Agent(name, role, file, config)
    sites = {agent.config.site: agent.file for agent in agents.values()}
    if len(sites) > 1:
        listed = ", ".join(f"{file.name}: {site}" for site, file in sites.items())
        raise InputError(f"agents of several sites ({listed})", file=folder, remedy="give all the same site")
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


def write_agent_configs(rig: RigFolder, out: Path, *, simulated: bool, endpoint: str | None) -> tuple[Agent, ...]:
    """Write the effective configuration of each agent to OUT/config, and return the agents with those files.

    The outputs of hubs and recorders go below ``out``. simulated: cameras view the simulated scene with its own
    intrinsics, and rig.toml is that of the scene. endpoint: router endpoint for all agents, instead of those in their
    files; None = keep those.
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
            bus = BusConfig(mode="router", listen=(endpoint,)) if agent.role == "router" else client_bus(endpoint)
            config = msgspec.structs.replace(config, bus=bus)
        if isinstance(config, HubConfig | RecorderConfig):
            config = msgspec.structs.replace(config, out=_output_path(agent, out))
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


def client_bus(endpoint: str) -> BusConfig:
    """Bus settings of a client of one router."""
    return BusConfig(mode="client", connect=(endpoint,))


def _output_path(agent: Agent, out: Path) -> Path:
    given = read_toml(agent.file)[0].get("out")
    default = "recordings" if agent.role == "recorder" else agent.name
    place = Path(given or default).expanduser()
    return place if place.is_absolute() else out.resolve() / place


def _simulated_camera(
    config: CameraConfig, world: SimulatedWorldConfig, cameras: Sequence[str], began: float, folder: Path
) -> CameraConfig:
    simulated_camera = SimulatedConfig(
        scene=world.scene,
        seed=world.seed,
        cameras=max(len(cameras), 2),
        start_unix_s=began,
        camera=f"cam{cameras.index(config.id)}",
        width=world.width,
        fps=world.fps,
    )
    rig = None if config.rig is None else folder / "rig.toml"
    return msgspec.structs.replace(
        config, driver="simulated", simulated=simulated_camera, video=None, oak=None, rig=rig
    )


def _simulated_flight(config: Any, world: SimulatedWorldConfig, began: float) -> Any:
    """The configuration of a UAV agent over the simulated town, with an autopilot on a free port."""
    from deploy.config.uav import MavlinkConfig, SimulatedFlightConfig

    autopilot = f"127.0.0.1:{free_udp_port()}"
    flight = SimulatedFlightConfig(
        autopilot=autopilot,
        seed=world.seed,
        seconds=_FLIGHT_DURATION_S,
        gimbal=config.mount == "gimbal",
        start_unix_s=began,
    )
    link = MavlinkConfig(url=f"udpout:{autopilot}")
    return msgspec.structs.replace(
        config, driver="simulated", simulated=flight, video=None, oak=None, rig=None, mavlink=link, video_out=None
    )


def _simulated_rig(rig: RigFolder, cameras: Sequence[str]) -> dict[str, Any]:
    """Tables of rig.toml of the simulated scene: its intrinsics, and true distances for the pairs given in the rig."""
    from edge import scenes
    from edge.scenes.common.base import rescale_scene

    scene = rescale_scene(
        scenes.get_marker_scene(rig.world.scene, rig.world.seed, max(len(cameras), 2)), rig.world.width, rig.world.fps
    )
    where = {name: scene.cameras[index] for index, name in enumerate(cameras)}
    tables: dict[str, Any] = {
        name: {"name": name, "fps": camera.fps, **camera.intrinsics.table()} for name, camera in where.items()
    }
    metadata: dict[str, Any] = {"name": f"{rig.name}, simulated", "units": "m"}
    wanted = {frozenset((a, b)) for a, b, _ in (() if rig.rig is None else rig.rig.distances)}
    metadata["distances"] = [
        [a, b, float(np.linalg.norm(where[a].pose.position - where[b].pose.position))]
        for a, b in combinations(cameras, 2)
        if frozenset((a, b)) in wanted
    ]
    return {"metadata": metadata, **tables}
