"""Tables for notebooks: pandas, where it is installed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from protocols.core.errors import InputError

if TYPE_CHECKING:
    import pandas


def dataframe(columns: Mapping[str, Any]) -> pandas.DataFrame:
    """A pandas DataFrame of columns of equal length. Raises InputError where pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise InputError("pandas is not installed", remedy="pip install pandas") from None
    return pandas.DataFrame(dict(columns))
