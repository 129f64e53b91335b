"""Remedies: what a user can do about each reason for a refusal."""

from __future__ import annotations

_LONGER = (
    "record longer while the point moves fast and irregularly (change direction and height, never the same "
    "loop twice) where both cameras see it"
)

# text in the reason → what to do; the first match is used
_REMEDIES: tuple[tuple[str, str], ...] = (
    ("no observations", "check that the camera recorded and whether its detector finds the point."),
    ("no intrinsics", "measure the lens: `syncline intrinsics VIDEO --out rig.toml`."),
    ("one camera only", "add a second camera that sees the same point."),
    (
        "fewer than two cameras",
        "check that at least two cameras record the point and have their intrinsics in rig.toml.",
    ),
    ("too few connected", "record for a minute or more with the point in view, without long breaks."),
    ("hardly moves", f"move the point: {_LONGER}."),
    ("two alignments", f"the motion repeats itself: {_LONGER}."),
    ("of motion agree", f"{_LONGER}."),
    ("no label", "use the same label for the same point in every camera."),
    (
        "fit the trajectory seen by the other cameras",
        "check that it detected the same point, and that its intrinsics and times are right.",
    ),
    ("no position", f"{_LONGER}."),
    ("behind a camera", f"check the intrinsics in rig.toml; {_LONGER}."),
    ("agrees with", f"check that both detected the same point and that their intrinsics are right; {_LONGER}."),
    ("px", "check the intrinsics in rig.toml and remove false detections."),
)


def remedy_for(reason: str) -> str:
    """One sentence on what to do about a reason; it starts in lower case, to follow a camera name."""
    for words, remedy in _REMEDIES:
        if words in reason:
            return remedy
    return f"{_LONGER}."
