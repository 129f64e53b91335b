"""The size of the house: source lines, constants without a reason, complexity. A figure that rises is explained."""

from __future__ import annotations

import ast
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

from tests.unit.test_structure import PACKAGES, ROOT, _tracked

MOST_SOURCE_LINES = 101360
MOST_UNEXPLAINED_CONSTANTS = 0
MOST_COMPLEXITY = 15


def source_files() -> list[Path]:
    """The modules of the four packages without generated ones."""
    names = _tracked(*(f"{package}/*.py" for package in PACKAGES))
    return [ROOT / name for name in names if "_pb2" not in name]


def unexplained_constants(text: str) -> Iterator[tuple[int, str]]:
    """(line, name) of each number at a module's top without a comment beside or above it, or a text below it."""
    body, lines = ast.parse(text).body, text.splitlines()
    for node, following in zip_longest(body, body[1:]):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None or not _is_numeric(node.value):
            continue
        explained = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
        beside = any("#" in line for line in lines[node.lineno - 1 : node.end_lineno])
        above = node.lineno > 1 and lines[node.lineno - 2].startswith("#")
        if not (explained or beside or above):
            yield node.lineno, ast.unparse(node).partition(" =")[0]


def _is_numeric(value: ast.expr) -> bool:
    """Whether an expression consists of numbers."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    if isinstance(value, ast.UnaryOp):
        return _is_numeric(value.operand)
    if isinstance(value, ast.BinOp):
        return _is_numeric(value.left) and _is_numeric(value.right)
    return isinstance(value, ast.Tuple) and bool(value.elts) and all(map(_is_numeric, value.elts))


def test_the_source_does_not_grow() -> None:
    count = sum(len(file.read_text(encoding="utf-8").splitlines()) for file in source_files())
    assert count <= MOST_SOURCE_LINES, f"{count} lines: merge or delete something, or say why it is worth it"


def test_constants_give_a_reason() -> None:
    found = [
        f"{file.relative_to(ROOT)}:{line} {name}"
        for file in source_files()
        for line, name in unexplained_constants(file.read_text(encoding="utf-8"))
    ]
    assert len(found) <= MOST_UNEXPLAINED_CONSTANTS, "\n".join(found)


def bound_twice(text: str) -> list[str]:
    """Names in capitals that a module binds twice: the first value holds nowhere, not even above the second."""
    targets = (t for node in ast.parse(text).body if isinstance(node, ast.Assign) for t in node.targets)
    names = (n for target in targets for n in ast.walk(target) if isinstance(n, ast.Name))
    stored = Counter(n.id for n in names if isinstance(n.ctx, ast.Store))
    return [name for name, times in stored.items() if times > 1 and name.lstrip("_").isupper()]


def test_a_constant_has_one_value() -> None:
    assert bound_twice("_A = 1\n_B, C = 2, 3\nC = 4\na = 1\na = 2\n") == ["C"]
    found = {file: bound_twice(file.read_text(encoding="utf-8")) for file in source_files()}
    assert not [(file, names) for file, names in found.items() if names]


def test_ruff_limits_complexity_without_exceptions() -> None:
    lint = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["ruff"]["lint"]
    assert "C901" in lint["select"]
    assert lint["mccabe"]["max-complexity"] <= MOST_COMPLEXITY
    assert not any("C901" in rules for rules in lint.get("per-file-ignores", {}).values())
    silenced = [file for file in source_files() if re.search(r"noqa:.*C901", file.read_text(encoding="utf-8"))]
    assert not silenced


def test_a_number_without_a_word_is_found_and_one_with_a_word_is_not() -> None:
    text = 'A = 3\nB = 4  # px\nC = (1.0, -2.0 * 3)\n"""[s]."""\n# Above.\nD = 2**10\nE = "text"\nF = -1, 2\nG = True\n'
    assert [name for _, name in unexplained_constants(text)] == ["A", "F"]
