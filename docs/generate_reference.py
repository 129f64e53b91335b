"""MkDocs hook: fills the parts of docs/reference that the code defines, so that they cannot disagree with it.

A page marks such a part by a fenced block:

    ```commands            every command with its options, from the command line application
    ```config hub.bus      a table of an agent's TOML file: names, types, defaults and limits from the msgspec struct;
                           the lines `key: meaning` inside the block are the page's own
    ```topics              the bus topics, from the catalogue
    ```messages            the messages and their fields, from syncline.proto

In mkdocs.yml: `hooks: [docs/generate_reference.py]` and `exclude_docs: generate_reference.py`. What the code has and a
page does not explain, or the other way round, is a warning, which `mkdocs build --strict` turns into a failure.
`python docs/generate_reference.py PAGE` prints one page as it will be rendered.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

_LOG = logging.getLogger("mkdocs.hooks.generate_reference")
_BLOCK = re.compile(r"^```(commands|config|topics|messages)(?: +([a-z0-9_.]+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_ROOTS = {
    "camera": "CameraConfig",
    "hub": "HubConfig",
    "recorder": "RecorderConfig",
    "router": "RouterConfig",
    "uav": "UavConfig",
    "fleet": "FleetFile",
    "site": "SiteFile",
}
_CONFIG_MODULE = re.compile(r"config|fleet|rig|site_file")


def on_page_markdown(markdown: str, page: Any = None, config: Any = None, files: Any = None) -> str:
    """MkDocs event: the page with its generated blocks filled in."""
    return expand(markdown)


def expand(markdown: str) -> str:
    """A page's text with its generated blocks filled in."""
    makers: dict[str, Callable[[str, str], str]] = {
        "commands": lambda name, body: _commands(),
        "config": _config,
        "topics": lambda name, body: _topics(),
        "messages": lambda name, body: _messages(),
    }
    return _BLOCK.sub(lambda found: makers[found[1]](found[2] or "", found[3]), markdown)


def _commands() -> str:
    """Every command as a section. A command's help is imported only when it is asked for by name."""
    from deploy.cli import build_app

    names = [name for name in build_app() if not name.startswith("-")]
    parts = []
    for name in names:
        command = build_app(name)[name]
        text = command.generate_docs(output_format="markdown", heading_level=2)
        parts.append(_tidied(text))
    return "\n\n".join(parts)


def _tidied(text: str) -> str:
    """The generated text of one command: full name in headings and usage, examples as code, no table of contents."""
    text = re.sub(r"^#+ Table of Contents\n.*?(?=^\*\*|^#)", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^\*\*Commands\*\*:\n.*?(?=^#)", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^(#+) (.+)$", r"\1 syncline \2", text, flags=re.MULTILINE)
    text = re.sub(r"^```console\n(?!syncline )", "```console\nsyncline ", text, flags=re.MULTILINE)
    text = re.sub(r" *\*\[default: (\(\)|False|)\]\*", "", text)
    text = re.sub(r"(?<=\w)\*(?=\.\w)", r"\\*", text)  # hub*.toml is no emphasis
    out: list[str] = []
    code = item = False
    for line in text.splitlines():
        if re.match(r" *```", line):
            code = not code
        if not code and line.startswith("Example:"):
            out += ["", "```console", f"$ {line.removeprefix('Example:').strip()}", "```", ""]
            item = True  # a long example goes on in the next line
        elif not code and item and line.strip() and not line.startswith(("*", "#", "`")):
            out[-3] += f" {line.strip()}"
        else:
            item = False
            # [,width][,height] is no link.
            out.append(line if code else re.sub(r"(?<!\*)\[(?!required|choices|default)", r"\\[", line))
    return re.sub(r"\n{3,}", "\n\n", "\n".join(out)).strip()


def _config(name: str, body: str) -> str:
    """One table of an agent's file. name: the agent, then the keys that lead to the table, as in camera.marker."""
    from msgspec import NODEFAULT, inspect

    meanings = dict(_meanings(name, body))
    struct: Any = inspect.type_info(_struct(name.split(".")[0]))
    for key in name.split(".")[1:]:
        field = next(field for field in struct.fields if field.encode_name == key)
        struct = next(kind for kind in _options(field.type) if isinstance(kind, inspect.StructType))
    lines = ["| key | type | default | meaning |", "| --- | --- | --- | --- |"]
    for field in struct.fields:
        if any(isinstance(kind, inspect.StructType) for kind in _options(field.type)):
            continue  # a table of its own
        if field.encode_name not in meanings:
            _LOG.warning("config %s: the page does not explain the key %s", name, field.encode_name)
        default = field.default
        if default is NODEFAULT:
            default = "required" if field.required else f"`{_value(field.default_factory())}`"
        else:
            default = "absent" if default is None else f"`{_value(default)}`"
        meaning = meanings.pop(field.encode_name, "")
        lines.append(f"| `{field.encode_name}` | {_kind(field.type)} | {default} | {meaning} |")
    for key in meanings:
        _LOG.warning("config %s: there is no key %s", name, key)
    return "\n".join(lines)


def _meanings(name: str, body: str) -> Iterator[tuple[str, str]]:
    for line in filter(None, map(str.strip, body.splitlines())):
        key, colon, meaning = line.partition(": ")
        if not colon:
            _LOG.warning("config %s: %r is not `key: meaning`", name, line)
        yield key, meaning


def _struct(agent: str) -> type:
    """The struct of an agent's file, wherever in deploy it is."""
    import deploy

    for module in pkgutil.walk_packages(deploy.__path__, "deploy."):
        if _CONFIG_MODULE.search(module.name):
            found = getattr(importlib.import_module(module.name), _ROOTS[agent], None)
            if isinstance(found, type):
                return found
    raise LookupError(f"there is no {_ROOTS[agent]} in deploy")


def _options(kind: Any) -> tuple[Any, ...]:
    return tuple(getattr(kind, "types", (kind,)))


def _kind(kind: Any) -> str:
    """A type in words, with its limits."""
    from msgspec import inspect

    if isinstance(kind, inspect.UnionType):
        return " or ".join(_kind(one) for one in kind.types if not isinstance(one, inspect.NoneType))
    if isinstance(kind, inspect.LiteralType):
        return ", ".join(f'`"{value}"`' for value in kind.values)
    if isinstance(kind, inspect.VarTupleType):
        return f"list of: {_kind(kind.item_type)}"
    if isinstance(kind, inspect.TupleType):
        kinds = [_kind(one) for one in kind.item_types]
        return f"{len(kinds)} × {kinds[0]}" if len(set(kinds)) == 1 else f"[{', '}.join(kinds)]"
    if isinstance(kind, inspect.CustomType):
        return {"Path": "path", "Source": "path, URL or number"}.get(kind.cls.__name__, kind.cls.__name__)
    words = {"IntType": "integer", "FloatType": "number", "StrType": "text", "BoolType": "true or false"}
    text = words.get(type(kind).__name__, type(kind).__name__.removesuffix("Type").lower())
    limits = []
    for attribute, sign in (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤")):
        limit = getattr(kind, attribute, None)
        if limit is not None:
            limits.append(f"{sign} {limit:,.10g}")
    if getattr(kind, "max_length", None):
        limits.append(f"at most {kind.max_length} characters")
    return f"{text} ({', '.join(limits)})" if limits else text


def _value(value: Any) -> str:
    """A default as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_value(one) for one in value) + "]"
    if isinstance(value, int | float):
        return repr(value)
    return f'"{value}"'


def _topics() -> str:
    """The table of topics."""
    from protocols.topics import TOPICS

    lines = [
        "| topic | key below `syncline/SITE/` | message | delivery | rate [Hz] | recorded | queue | stale after [s] |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for topic in TOPICS:
        rate = f"{topic.rate_hz:g}" if topic.rate_hz else "on change"
        stale = f"{topic.stale_after_s:g}" if topic.stale_after_s else "never"
        bulk = ", bulk lane" if topic.bulky else ""
        lines.append(
            f"| {topic.name} | `{topic.key}` | [{topic.message}](#{topic.message.lower()}) | "
            f"{topic.delivery.value}{bulk} | {rate} | {'yes' if topic.recorded else 'no'} | {topic.queue} | {stale} |"
        )
    return "\n".join(lines)


def _messages() -> str:
    """A section for each message of syncline.proto, with the comments that stand there."""
    file = next(iter(sorted((ROOT / "protocols").rglob("syncline.proto"))), None)
    if file is None:
        raise LookupError("there is no syncline.proto in protocols")
    heads: dict[str, str] = {}
    rows: dict[str, list[str]] = {}
    comments: list[str] = []
    nesting: list[str] = []
    for line in file.read_text(encoding="utf-8").splitlines():
        text = line.strip()
        begins = re.match(r"message (\w+) \{", text)
        field = re.match(r"((?:repeated |optional )?[\w.<>, ]+?) (\w+) = \d+;(?:\s*//\s*(.*))?$", text)
        if begins:
            nesting.append(begins[1])
            heads[".".join(nesting)], rows[".".join(nesting)] = " ".join(comments), []
            comments = []
        elif text == "}" and nesting:
            nesting.pop()
        elif field and nesting:
            meaning = (field[3] or " ".join(comments)).replace("|", "&#124;")
            rows[".".join(nesting)].append(f"| `{field[2]}` | {field[1].replace('<', '&lt;')} | {meaning} |")
            comments = []
        elif text.startswith("//"):
            comments.append(text.removeprefix("//").strip())
        elif not text:
            comments = []
    parts = []
    for name, text in heads.items():
        table = "\n".join(["| field | type | meaning |", "| --- | --- | --- |", *rows[name]])
        parts.append("\n\n".join([f"### {name}", *([text] if text else []), table]))
    return "\n\n".join(parts)


if __name__ == "__main__":
    for given in sys.argv[1:]:
        print(expand(Path(given).read_text(encoding="utf-8")))
