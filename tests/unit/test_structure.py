"""The structure of the code base: entries per folder, circles of imports, words in READMEs."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file())
PACKAGES = ("protocols", "edge", "hub", "deploy")
MOST_AT_TOP = 14
MOST_IN_A_FOLDER = 16
CONFIGURATION_SETS = ("deploy/examples/",)
"""Sets of configuration files are as large as the rig that they show."""
MOST_WORDS = {"README.md": 600}
MOST_WORDS_OF_A_FOLDER = 400


def _tracked(*patterns: str) -> list[str]:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [name for name in listed.stdout.splitlines() if (ROOT / name).exists()]


def _entries(folder: str, files: list[str]) -> set[str]:
    """Names directly below a folder; Python's own __init__.py, __main__.py and py.typed are not counted."""
    below = {file[len(folder) + 1 :].split("/")[0] for file in files if file.startswith(f"{folder}/")}
    return {name for name in below if not name.startswith("__") and name != "py.typed"}


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_shows_few_entries_at_its_top(package: str) -> None:
    entries = _entries(package, _tracked())
    assert len(entries) <= MOST_AT_TOP, sorted(entries)


def test_no_folder_holds_more_than_a_reader_takes_in_at_a_glance() -> None:
    files = _tracked()
    folders = {str(parent) for file in files for parent in Path(file).parents if file.startswith(PACKAGES)}
    crowded = {
        folder: len(_entries(folder, files))
        for folder in folders
        if not f"{folder}/".startswith(CONFIGURATION_SETS) and len(_entries(folder, files)) > MOST_IN_A_FOLDER
    }
    crowded.pop(".", None)
    assert not crowded


def test_readmes_are_short() -> None:
    long = {}
    for name in _tracked("*README.md"):
        words = len((ROOT / name).read_text(encoding="utf-8").split())
        if words > MOST_WORDS.get(name, MOST_WORDS_OF_A_FOLDER):
            long[name] = words
    assert not long


def _imports(name: str, file: Path, modules: set[str]) -> set[str]:
    """The project's modules that one imports: at its top, inside functions and for type checking alike."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                full if (full := f"{node.module}.{alias.name}") in modules else node.module for alias in node.names
            }
    return (found & modules) - {name}


def test_a_module_imports_from_others_and_above_what_it_imports_for_types() -> None:
    wrong = []
    for name in _tracked(*(f"{package}/*.py" for package in PACKAGES)):
        tree, own = ast.parse((ROOT / name).read_text(encoding="utf-8")), name.removesuffix(".py").replace("/", ".")
        wrong += [name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == own]
        kinds = [ast.unparse(node).partition("\n")[0] for node in tree.body]
        below = kinds[kinds.index("if TYPE_CHECKING:") :] if "if TYPE_CHECKING:" in kinds else []
        wrong += [name for kind in below if kind.startswith(("import ", "from "))]
    assert not wrong


def import_graph() -> dict[str, set[str]]:
    """Who imports whom among the modules of the four packages; lazy and type-only imports count."""
    files = {}
    for name in _tracked(*(f"{package}/*.py" for package in PACKAGES)):
        files[re.sub(r"(/__init__)?\.py$", "", name).replace("/", ".")] = ROOT / name
    return {name: _imports(name, file, set(files)) for name, file in files.items()}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one node (Tarjan, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            at = stack.index(node)
            component = stack[at:]
            del stack[at:]
            if len(component) > 1:
                found.append(sorted(component))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def test_modules_import_in_no_circle() -> None:
    assert not circles(import_graph())


def _rooms(graph: dict[str, set[str]], package: str) -> dict[str, set[str]]:
    """The same between the rooms of one package: its folders, and modules at its top."""
    rooms: dict[str, set[str]] = {}
    for name, others in graph.items():
        if name.startswith(f"{package}."):
            own = name.split(".")[1]
            rooms.setdefault(own, set()).update(
                other.split(".")[1]
                for other in others
                if other.startswith(f"{package}.") and other.split(".")[1] != own
            )
    return rooms


@pytest.mark.parametrize("package", PACKAGES)
def test_rooms_import_in_no_circle(package: str) -> None:
    assert not circles(_rooms(import_graph(), package))


def test_a_circle_is_found_where_there_is_one() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
