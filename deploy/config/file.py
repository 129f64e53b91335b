"""Reads a configuration file into its struct, with errors that name file, line, key and remedy."""

from __future__ import annotations

import difflib
import math
import re
from pathlib import Path
from typing import Any, TypeVar, get_args

import msgspec

from protocols.core.errors import InputError
from protocols.core.files import parse_toml, read_toml, toml_line

_Config = TypeVar("_Config", bound=msgspec.Struct)


class Source(str):
    """A video source: a file, a URL such as rtsp://…, or a camera's number or device file."""

    __slots__ = ()


class DetectorName(str):
    """A detector: a name, or the .toml file of a network."""

    __slots__ = ()


class KnownName(str):
    """A calibration.toml, or "last": the hub's own last answer."""

    __slots__ = ()


_PLACE = re.compile(r" - at `\$\.?(?P<path>[^`]*)`\Z")
_UNKNOWN = re.compile(r"Object contains unknown field `(?P<key>[^`]*)`\Z")
_MISSING = re.compile(r"Object missing required field `(?P<key>[^`]*)`\Z")


def load(path: Path | str, kind: type[_Config]) -> _Config:
    """Read a TOML file as ``kind``.

    Relative paths in it are resolved from the file's own folder. Raises InputError with file, line (if it can be
    determined), key and remedy.
    """
    file = Path(path)
    table, text = read_toml(file, "configuration")
    return _convert(table, text, kind, file, file.resolve().parent)


def convert(text: str, kind: type[_Config], folder: Path) -> _Config:
    """The same for the text of a file that lies elsewhere. folder: what relative paths in it are resolved from."""
    return _convert(parse_toml(text, folder), text, kind, folder, folder)


def _convert(table: dict[str, Any], text: str, kind: type[_Config], file: Path, folder: Path) -> _Config:
    bad = _not_finite(table, "")
    if bad:
        raise InputError(f"{bad} is not finite", file=file, line=_line(text, bad), remedy="give a number")
    try:
        return msgspec.convert(table, kind, dec_hook=lambda wanted, value: _from_text(wanted, value, folder))
    except msgspec.ValidationError as error:
        raise _content_error(file, text, kind, str(error)) from None


def effective_toml(config: msgspec.Struct) -> str:
    """The configuration with every default filled in, as TOML from which ``load`` reads an equal configuration."""
    import tomli_w

    return tomli_w.dumps(_without_none(msgspec.to_builtins(config, enc_hook=str)))


def _from_text(wanted: type, value: object, folder: Path) -> object:
    if not isinstance(value, str) or not value:
        raise ValueError(f"Expected a text that is not empty, got {value!r}")
    if wanted is Path:
        return folder / Path(value).expanduser()
    if wanted is Source:
        elsewhere = "://" in value or value.isdigit()
        return Source(value if elsewhere else folder / Path(value).expanduser())
    if wanted is KnownName:
        return KnownName(value if value == "last" else folder / Path(value).expanduser())
    if wanted is DetectorName:
        path = folder / Path(value).expanduser()
        return DetectorName(path if path.suffix.lower() == ".toml" else value)
    raise TypeError(f"no reader for {wanted}")


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [_without_none(inner) for inner in value]
    return value


def _not_finite(value: object, path: str) -> str:
    """The dotted path of the first number that is not finite; "" if there is none."""
    if isinstance(value, float) and not math.isfinite(value):
        return path
    inner: list[tuple[str, object]] = []
    if isinstance(value, dict):
        inner = [(f"{path}.{key}" if path else str(key), item) for key, item in value.items()]
    elif isinstance(value, list):
        inner = [(f"{path}[{index}]", item) for index, item in enumerate(value)]
    return next((bad for name, item in inner if (bad := _not_finite(item, name))), "")


def _content_error(file: Path, text: str, kind: type[msgspec.Struct], message: str) -> InputError:
    """A one-line error from the validator's message, which ends in the path of the value concerned."""
    path = ""
    place = _PLACE.search(message)
    if place:
        path, message = place["path"], message[: place.start()]
    unknown, missing = _UNKNOWN.match(message), _MISSING.match(message)
    if unknown:
        key = f"{path}.{unknown['key']}" if path else unknown["key"]
        known = _keys(kind, path)
        close = difflib.get_close_matches(unknown["key"], known, 1)
        remedy = f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
        return InputError(f"unknown key {key}", file=file, line=_line(text, key), remedy=remedy)
    if missing:
        where = f" in [{path}]" if path else ""
        remedy = f"add {missing['key']} = …"
        return InputError(f"{missing['key']} is missing{where}", file=file, line=_line(text, path), remedy=remedy)
    if not path:
        # The message of a struct's own check has no path, but begins with the key concerned.
        first = re.match(r"\w+", message)
        line = _line(text, first[0]) if first and first[0] in _keys(kind, "") else None
        return InputError(message, file=file, line=line, remedy="" if ";" in message else "correct it")
    choices = get_args(_type_of(kind, path))
    if message.startswith("Invalid enum value") and choices:
        remedy = f"use one of {', '.join(map(str, choices))}"
    else:
        remedy = "correct it"
    what = f"{path}: {message[0].lower()}{message[1:]}".replace("`", "")
    return InputError(what, file=file, line=_line(text, path), remedy=remedy)


def _keys(kind: type[msgspec.Struct], path: str) -> list[str]:
    """The allowed keys of the table at a dotted path; none if it is not a table."""
    wanted = _type_of(kind, path)
    for option in (wanted, *get_args(wanted)):
        if isinstance(option, type) and issubclass(option, msgspec.Struct):
            return [field.encode_name for field in msgspec.structs.fields(option)]
    return []


def _type_of(kind: type[msgspec.Struct], path: str) -> Any:
    """The declared type of the value at a dotted path; None if there is none."""
    wanted: Any = kind
    for name in path.split(".") if path else []:
        options = [item for item in (wanted, *get_args(wanted)) if isinstance(item, type)]
        structs = [item for item in options if issubclass(item, msgspec.Struct)]
        fields = {field.encode_name: field.type for field in msgspec.structs.fields(structs[0])} if structs else {}
        wanted = fields.get(name)
    return wanted


def _line(text: str, path: str) -> int | None:
    """The line number of a dotted key, or of its table; None if it is not found."""
    path = re.sub(r"\[[^\]]*\]", "", path)
    table, _, key = path.rpartition(".")
    return toml_line(text, path) or toml_line(text, table, key or None)
