"""The rule for names of cameras and other agents, and the bus-key segment and file names derived from a name.

A name is what the user calls a camera. Session files, logs, messages, exports and configurations all carry the name
itself; only a bus key and what is made of one (certificate, systemd unit) carries the segment derived from it.

=================  ==================================================================================================
characters         letters of any script and case with their combining marks, decimal digits, ``-``, ``_``, ``.``, space
first and last     neither a space nor a full stop; not a combining mark first
length             1 to 63 characters and at most 200 bytes of UTF-8
form               Unicode NFC, so that two names which look the same are the same
reserved           ``metadata``, which is a table of its own in rig.toml
=================  ==================================================================================================

So a name is a safe file name: no separator, no control character, neither ``.`` nor ``..``.
"""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path
from urllib.parse import quote, unquote

from protocols.core.errors import InputError

MAX_CHARACTERS = 63  # fits into a key segment and a certificate's common name
MAX_BYTES = 200
"""UTF-8 bytes of a name: with a suffix it stays below the 255 bytes that file systems allow for a file name."""
MAX_SEGMENT = 3 * MAX_BYTES
"""Characters of a key segment: a byte that is escaped takes three."""
RESERVED = frozenset({"metadata"})
REMEDY = f"use at most {MAX_CHARACTERS} letters, digits, '-', '_', '.' and spaces; no space or full stop at either end"

_PLAIN = re.compile(r"[A-Za-z0-9_-]{1,63}\Z")
_IDENTIFIER = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}\Z")
_PUNCTUATION = frozenset("-_. ")


def is_name(text: str) -> bool:
    """Whether ``text`` may name a camera or another agent."""
    return (_PLAIN.match(text) is not None and text not in RESERVED) or not _problem(text)


def check_name(text: str, what: str = "camera name", *, file: Path | None = None, line: int | None = None) -> str:
    """Return ``text`` if it may name a camera or another agent; raise InputError, one line, otherwise.

    what: what it names, for the message. file, line: where it stands, where that is known.
    """
    if is_name(text):
        return text
    raise InputError(f"{what} {_shown(text)} is not usable: it {_problem(text)}", file=file, line=line, remedy=REMEDY)


def name_from_file(stem: str, file: Path | None = None) -> str:
    """The camera's name of a file that is named after it; raises InputError where the stem is not a name.

    Some file systems store names decomposed (NFD): the name is their NFC form.
    """
    return check_name(unicodedata.normalize("NFC", stem), file=file)


def key_segment(name: str) -> str:
    """The segment of a bus key that stands for ``name``: percent-encoded UTF-8 (RFC 3986, section 2.1).

    ASCII letters, digits, ``-`` and ``_`` stand for themselves, every other byte is ``%XX`` (upper-case hexadecimal).
    A full stop is escaped too, because certificate names use it as a separator. The mapping is injective, and at
    most ``MAX_SEGMENT`` characters long. Zenoh's special characters (``*``, ``$``, ``?``, ``#``, ``/``) never occur:
    one of them in a declared key would stop the routing of a router permanently. Raises InputError for a bad name.
    """
    if _PLAIN.match(name) and name not in RESERVED:
        return name
    return quote(check_name(name, "id"), safe="").replace(".", "%2E")


def name_of_segment(segment: str) -> str | None:
    """The inverse of ``key_segment``; None for what ``key_segment`` never gives.

    One name has one segment only: otherwise access rules, which compare segments, could be evaded.
    """
    if "%" not in segment:
        return segment if _PLAIN.match(segment) and segment not in RESERVED else None
    if len(segment) > MAX_SEGMENT:
        return None
    try:
        name = unquote(segment, errors="strict")
    except UnicodeDecodeError:
        return None
    return name if is_name(name) and key_segment(name) == segment else None


def check_identifier(text: str, what: str = "id") -> str:
    """Return ``text`` if it may be the id of a site, a role or a boot, which stand in bus keys as they are.

    Raises InputError otherwise.
    """
    if not _IDENTIFIER.match(text):
        raise InputError(
            f"{what} {_shown(text)} is not usable",
            remedy="use 1 to 63 lower-case letters, digits, '-' or '_', beginning with a letter or digit",
        )
    return text


def _shown(text: str) -> str:
    """At most 80 characters of a text in quotes, escaped where they cannot be printed."""
    return (repr(text[:80]) if text[:80].isprintable() else ascii(text[:80])) + ("…" if len(text) > 80 else "")


def _problem(text: str) -> str:
    """What is wrong with a name; "" if nothing is."""
    if not text:
        return "is empty"
    if len(text) > MAX_CHARACTERS:
        return f"has {len(text)} characters, at most {MAX_CHARACTERS} are allowed"
    for character in text:
        category = unicodedata.category(character)
        if character not in _PUNCTUATION and category[0] not in "LM" and category != "Nd":
            return f"has a character that is not allowed ({_shown(character)})"
    if text in RESERVED:
        return "is reserved for a table of rig.toml"
    if text[0] in " ." or text[-1] in " .":
        return "begins or ends with a space or a full stop"
    if unicodedata.category(text[0])[0] == "M":
        return "begins with a combining mark"
    if len(text.encode()) > MAX_BYTES:
        return f"takes {len(text.encode())} bytes in UTF-8, at most {MAX_BYTES} are allowed"
    if not unicodedata.is_normalized("NFC", text):
        return "is not in Unicode's composed form (NFC)"
    return ""
