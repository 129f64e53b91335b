"""What every process agrees on. The names for use in a notebook are imported on first access."""

from protocols.core.lazy import lazy_names

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from protocols.core.errors import InputError, Refused, SynclineError
    from protocols.log.read.session import load_session
    from protocols.session.calibration import read_calibration
    from protocols.session.rig import read_rig
    from protocols.session.session import Session

__all__ = ["InputError", "Refused", "Session", "SynclineError", "load_session", "read_calibration", "read_rig"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "protocols.core.errors": ["InputError", "Refused", "SynclineError"],
        "protocols.log.read.session": ["load_session"],
        "protocols.session.calibration": ["read_calibration"],
        "protocols.session.rig": ["read_rig"],
        "protocols.session.session": ["Session"],
    },
)
