"""Bundles on an offline board: made for this machine, carried over, installed without an index, and run.

Making one needs a package index, once; without one these tests are skipped with a message.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from deploy.site.bundle import BUDGET_MB, Bundle, Target, make_bundle
from protocols.bus.settings import BusConfig
from protocols.bus.transport.zenoh_bus import open_bus
from protocols.core.errors import InputError
from protocols.topics import STATUS
from tests.faults.processes import ROOT, wait_until
from tests.support import image_builds

HERE = f"{sys.version_info.major}.{sys.version_info.minor}"
CONFIG = {
    "camera": ("camera", 'id = "cam0"\n[simulated]\nduration_s = 2.0\n'),
    "hub": ("hub", 'id = "hub"\n'),
    "recorder": ("record", 'id = "recorder"\nout = "log.mcap"\nmin_free_mb = 0.0\n'),
    "router": ("router", 'id = "router"\n[bus]\nlisten = ["tcp/127.0.0.1:0"]\n'),
    "uav": ("uav", ""),
}
OFFLINE = {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull, "PATH": os.environ["PATH"]}


def made(role: str, target: Target, out: Path) -> Bundle:
    try:
        return make_bundle(role, target, out)
    except InputError as error:
        if "connection" in error.remedy and ("No matching distribution" in error.what or "Could not" in error.what):
            pytest.skip(f"no package index here: BUNDLES ARE NOT TESTED ({error.what})")
        raise


@pytest.fixture(scope="module")
def own_bundle(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Bundle]:
    """The bundle of a role for this machine, made once."""
    bundles: dict[str, Bundle] = {}

    def get(role: str) -> Bundle:
        if role not in bundles:
            bundles[role] = made(role, Target(platform.machine(), HERE), tmp_path_factory.mktemp(role) / "bundle")
        return bundles[role]

    return get


@pytest.mark.parametrize("role", sorted(CONFIG))
def test_a_bundle_installs_without_an_index_and_its_agent_runs(
    role: str, tmp_path: Path, own_bundle: Callable[[str], Bundle]
) -> None:
    bundle = own_bundle(role)
    board = tmp_path / "board"
    for _ in range(2):  # twice: a newer bundle is installed over an older one the same way
        ended = subprocess.run(
            ["sh", str(bundle.out / "install.sh"), str(board)],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            env={**OFFLINE, "SYNCLINE_PYTHON": sys.executable, "PYTHON": "3.11"},
        )
        assert ended.returncode == 0, ended.stderr
    if role in BUDGET_MB:
        files = (file for file in board.rglob("*") if file.is_file() or file.is_symlink())
        assert sum(file.lstat().st_size for file in files) <= 1e6 * BUDGET_MB[role], ended.stdout
    # What the role does not need is not there, and it starts without it.
    packages = {path.name for path in (board / "lib" / f"python{HERE}" / "site-packages").iterdir()}
    assert not [*board.glob("lib/**/tests/*.py")], "packages' own tests"
    assert ("plotly" in packages) == (role == "hub")
    assert ("scipy" in packages) == (role in ("hub", "uav"))
    command, text = CONFIG[role]
    if not text:
        assert subprocess.run([str(board / "bin/syncline"), command, "--help"], timeout=60, check=False).returncode == 0
        return
    (tmp_path / "agent.toml").write_text(text)
    alive = tmp_path / "alive"
    with (tmp_path / "log.txt").open("wb") as log:
        agent = subprocess.Popen(
            [str(board / "bin/syncline"), command, str(tmp_path / "agent.toml")],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**OFFLINE, "SYNCLINE_ALIVE_FILE": str(alive)},
        )
        try:
            for _ in range(600):
                if alive.exists() or agent.poll() not in (None, 0):
                    break
                try:
                    agent.wait(0.1)
                except subprocess.TimeoutExpired:
                    continue
            assert alive.exists(), (tmp_path / "log.txt").read_text()
            agent.terminate()
            assert agent.wait(60) == 0, (tmp_path / "log.txt").read_text()
        finally:
            if agent.poll() is None:
                agent.kill()
                agent.wait()


@pytest.mark.parametrize("role", sorted(BUDGET_MB))
def test_a_board_of_another_architecture_stays_within_its_budget(role: str, tmp_path: Path) -> None:
    bundle = made(role, Target("aarch64", "3.11"), tmp_path / "bundle")
    assert bundle.installed_mb <= 350.0, "of a small computer; a UAV's x86_64 may take more, see BUDGET_MB"
    wheels = [path.name for path in (bundle.out / "wheels").glob("*.whl")]
    assert any("aarch64" in name for name in wheels)
    assert not any("x86_64" in name for name in wheels)
    assert len((bundle.out / "requirements.txt").read_text().splitlines()) == len(wheels) - 1, "all but pip"


CONTAINERS = ROOT / "deploy" / "site" / "containers"
DEBIAN_PYTHON = Path("/usr/bin/python3")


@pytest.fixture(scope="module")
def images(
    tmp_path_factory: pytest.TempPathFactory, own_bundle: Callable[[str], Bundle]
) -> Iterator[dict[str, image_builds.Image]]:
    """The images of a site, built from the Containerfile in clean roots without a network."""
    if not image_builds.permitted():
        pytest.skip("NOT TRIED: mounts and namespaces are not permitted here")
    version = subprocess.run([str(DEBIAN_PYTHON), "--version"], capture_output=True, text=True, check=False).stdout
    if not version.startswith(f"Python {HERE}."):
        pytest.skip(f"NOT TRIED: the system's Python is not {HERE}: IMAGES ARE NOT BUILT")
    context = tmp_path_factory.mktemp("context")
    shutil.copy(CONTAINERS / "Containerfile", context)
    built = {}
    for role in ("router", "hub", "recorder", "camera"):
        shutil.copytree(own_bundle(role).out, context / "bundles" / role)
        place = tmp_path_factory.mktemp(f"image-{role}")
        # As an engine has it: the names of ARG and ENV are the environment of RUN.
        built[role] = image_builds.build(context / "Containerfile", role, place, {"PYTHON_VERSION": HERE})
    return built


def test_the_site_of_the_compose_file_runs_from_images_built_without_a_network(
    images: dict[str, image_builds.Image], tmp_path: Path
) -> None:
    services: dict[str, Any] = yaml.safe_load((CONTAINERS / "compose.yaml").read_text(encoding="utf-8"))["services"]
    with ExitStack() as stack:
        for name, service in services.items():
            image = images[service["image"].removeprefix("syncline-")]
            given, _, place = service["volumes"][0].partition(":")
            config = tmp_path / f"{name}.toml"
            text = (CONTAINERS / given).read_text(encoding="utf-8").replace('driver = "video"', 'driver = "simulated"')
            config.write_text(text, encoding="utf-8")
            state = tmp_path / f"{name}-state"
            state.mkdir()
            os.chown(state, 10001, 10001)
            binds = {config: place.partition(":")[0], state: "/var/lib/syncline"}
            words = image.words((*image.entrypoint, *image.command), network=True, binds=binds, sealed=True)
            log = stack.enter_context((tmp_path / f"{name}.txt").open("wb"))
            process = subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT)
            stack.callback(process.wait)
            stack.callback(process.terminate)
        states: dict[str, str] = {}
        with open_bus("room", BusConfig(mode="client"), timeout_s=30.0) as bus:
            statuses = bus.subscribe(STATUS)

            def all_run() -> bool:
                for one in statuses.drain():
                    states[one.message.agent] = one.message.state  # type: ignore[attr-defined]
                return all(states.get(name) == "running" for name in services)

            try:
                wait_until(all_run, 60.0)
            except AssertionError:
                logs = {name: (tmp_path / f"{name}.txt").read_text(encoding="utf-8") for name in services}
                raise AssertionError(f"{states} {logs}") from None
        assert list((tmp_path / "recorder-state").glob("*.mcap"))
