"""The `syncline` command."""


def main() -> None:
    """Placeholder replaced by the command line application."""
