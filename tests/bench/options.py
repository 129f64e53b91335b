"""Command lines of the benches: options by their defaults."""

from __future__ import annotations

import argparse
from typing import Any


def bench_parser(doc: str | None, **options: Any) -> argparse.ArgumentParser:
    """A parser of ``--name`` for each option. doc: of the module, as help.

    options: the default, a type (then the default is None), or either with a text of help; False is a switch.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, given in options.items():
        value, text = given if isinstance(given, tuple) else (given, None)
        flag = f"--{name.replace('_', '-')}"
        if value is False:
            parser.add_argument(flag, action="store_true", help=text)
        elif isinstance(value, type):
            parser.add_argument(flag, type=value, help=text)
        else:
            parser.add_argument(flag, type=type(value), default=value, help=text)
    return parser
