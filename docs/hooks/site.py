"""MkDocs hook: folders in the navigation, and equations as MathML.

Neither needs anything from the network when the site is read: browsers render MathML themselves.
"""

from __future__ import annotations

import html
import logging
import re
from pathlib import Path
from typing import Any

from latex2mathml import exceptions
from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.site")

# latex2mathml's errors have no common base of their own.
UNREADABLE = tuple(kind for kind in vars(exceptions).values() if isinstance(kind, type) and issubclass(kind, Exception))

# What pymdownx.arithmatex (generic) leaves in a page.
INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAYED = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_config(config: Any) -> Any:
    """Replace an entry "folder/" of the navigation by the pages in that folder; index.md comes first."""
    config.nav = _expand(config.nav, Path(config.docs_dir))
    return config


def _expand(entry: Any, docs: Path) -> Any:
    if isinstance(entry, list):
        return [_expand(item, docs) for item in entry]
    if isinstance(entry, dict):
        return {title: _expand(value, docs) for title, value in entry.items()}
    if entry.endswith("/"):
        pages = sorted((docs / entry).glob("*.md"), key=lambda page: (page.name != "index.md", page.name))
        if not pages:
            log.warning("mkdocs.yml: nav names %s, which has no page", entry)
        return [page.relative_to(docs).as_posix() for page in pages]
    return entry


def on_page_content(content: str, page: Any, **_: Any) -> str:
    """Render the equations of a page; one that cannot be rendered is a warning, and so an error with --strict."""

    def render(match: re.Match[str], display: str) -> str:
        try:
            return convert(html.unescape(match[1]).strip(), display=display)
        except (*UNREADABLE, ValueError, LookupError, TypeError) as error:
            log.warning("%s: equation %r cannot be rendered: %r", page.file.src_path, match[1], error)
            return match[0]

    content = INLINE.sub(lambda match: render(match, "inline"), content)
    return DISPLAYED.sub(lambda match: f'<div class="equation">{render(match, "block")}</div>', content)
