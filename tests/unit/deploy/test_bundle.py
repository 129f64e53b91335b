"""Contents of a bundle, without a package index: roles, tags, markers, the script."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from deploy.cli import run
from deploy.site.bundle import BUDGET_MB, ROLE_PACKAGES, Target, _lock, _requirements, _script
from protocols.core.errors import InputError
from tests.support.command_line import refusal


@pytest.mark.parametrize("role", sorted(ROLE_PACKAGES))
def test_packages_of_a_role_are_declared_by_the_project(role: str) -> None:
    found = {requirement.name: requirement for requirement in _requirements(role, Target("aarch64", "3.11"), ())}
    assert set(found) == set(ROLE_PACKAGES[role])
    assert all(requirement.specifier for requirement in found.values()), "a role without the project's bounds"
    assert all(requirement.marker is None for requirement in found.values())


def test_bundles_of_boards_exclude_packages_that_only_hubs_need() -> None:
    assert not any({"viser", "plotly"} & set(ROLE_PACKAGES[role]) for role in BUDGET_MB)
    assert "scipy" not in ROLE_PACKAGES["camera"]
    assert "scipy" in ROLE_PACKAGES["uav"], "its tracker and its alignment of clocks"
    assert "mcap" not in ROLE_PACKAGES["uav"]
    assert "mcap" in ROLE_PACKAGES["camera"], "the driver of logged pictures"


def test_extras_are_included() -> None:
    target = Target("aarch64", "3.11")
    plain = {requirement.name for requirement in _requirements("camera", target, ())}
    for extra, package in (("oak", "depthai"), ("v4l2", "linuxpy"), ("video", "av"), ("scipy", "scipy")):
        more = {requirement.name for requirement in _requirements("camera", target, (extra,))}
        assert more - plain == {package}
    with pytest.raises(InputError, match=r"no extra oac; use .*oak"):
        list(_requirements("camera", target, ("oak", "oac")))


def test_markers_of_the_lock_file_are_evaluated_for_the_board(tmp_path: Path) -> None:
    for python, wanted in (("3.11", "18."), ("3.13", "19.")):
        lock = _lock(Target("aarch64", python), tmp_path)
        assert lock is not None
        av = [line for line in lock.read_text().splitlines() if line.startswith("av==")]
        assert len(av) == 1
        assert av[0].startswith(f"av=={wanted}")
        assert not any("win32" in line or ";" in line for line in lock.read_text().splitlines())


def test_platform_tags_reach_from_the_oldest_board_to_debian_10() -> None:
    tags = Target("aarch64", "3.11").tags()
    assert {"manylinux_2_17_aarch64", "manylinux_2_28_aarch64", "manylinux2014_aarch64"} <= set(tags)
    assert "manylinux_2_29_aarch64" not in tags


def test_the_script_refuses_another_machine(tmp_path: Path) -> None:
    script = tmp_path / "install.sh"
    script.write_text(_script("camera", Target("riscv64", "3.11")))
    assert subprocess.run(["sh", "-n", str(script)], check=False).returncode == 0
    ended = subprocess.run(
        ["sh", str(script), str(tmp_path / "target")], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 1
    assert "this bundle is for riscv64" in ended.stderr
    assert not (tmp_path / "target").exists()


def test_without_a_network_an_earlier_bundle_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel = tmp_path / "wheels" / "numpy-2.0-cp311-cp311-any.whl"
    wheel.parent.mkdir()
    wheel.touch()
    monkeypatch.setattr("deploy.site.bundle._own_wheel", lambda folder: folder / "syncline.whl")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:1/simple")
    monkeypatch.setenv("PIP_RETRIES", "1")
    assert "the package index cannot be reached; make the bundle where" in refusal(
        capsys, ["bundle", "--out", str(tmp_path)]
    )
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [wheel]


def test_bad_use(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(["bundle", "--platform", "mips"]) == 2
    assert run(["bundle", "--role", "cook"]) == 2
    capsys.readouterr()
    (tmp_path / "file").touch()
    assert run(["bundle", "--out", str(tmp_path / "file")]) == 2
    assert "choose another --out" in capsys.readouterr().err
    monkeypatch.setitem(ROLE_PACKAGES, "camera", ("no-such-package",))
    with pytest.raises(InputError, match="does not declare no-such-package"):
        list(_requirements("camera", Target("aarch64", "3.11"), ()))
