"""Tutorials whose code is executed as it stands on the page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

DOCS = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file()) / "docs"
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def test_the_notebook_tutorial_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    blocks = PYTHON.findall((DOCS / "tutorials" / "notebook.md").read_text(encoding="utf-8"))
    assert len(blocks) > 8
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "notebook.md", "exec"), names)
    assert len(names["result"].cameras) == 3
    assert len(names["path"]) > 100
    assert len(names["points"].to_dataframe()) > 100
    for file in ("calibrated/calibration.toml", "calibrated/report.html", "points.csv"):
        assert (tmp_path / file).is_file(), file
    assert "cam0" in capsys.readouterr().out
