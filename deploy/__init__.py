"""The `syncline` command and its processes. The names for a notebook are imported on first access."""

from protocols.core.lazy import lazy_names

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from deploy.cli import run
    from deploy.offline.people_session import people_session
    from deploy.offline.video_folder import session_from_videos
    from deploy.simulation.session import write_simulated_session

__all__ = ["people_session", "run", "session_from_videos", "write_simulated_session"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "deploy.cli": ["run"],
        "deploy.offline.people_session": ["people_session"],
        "deploy.offline.video_folder": ["session_from_videos"],
        "deploy.simulation.session": ["write_simulated_session"],
    },
)
