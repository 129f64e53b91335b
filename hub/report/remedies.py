"""What a user can do about each reason for a refusal."""

from __future__ import annotations

_LONGER = (
    "record longer while the point moves fast and irregularly (change direction and height, never the same "
    "loop twice) where both cameras see it"
)

# words in the reason → what to do; the first that fits counts
_REMEDIES: tuple[tuple[str, str], ...] = (
    ("no observations", "see whether the camera recorded and whether its detector finds the point."),
    ("no intrinsics", "measure the lens: `syncline intrinsics VIDEO --out rig.toml`."),
    ("one camera only", "add a second camera that sees the same point."),
    ("fewer than two cameras", "see that at least two cameras record the point and have their lens in rig.toml."),
    ("too few connected", "record for a minute or more with the point in view, without long breaks."),
    ("hardly moves", f"move the point: {_LONGER}."),
    ("two alignments", f"the motion repeats itself: {_LONGER}."),
    ("of motion agree", f"{_LONGER}."),
    ("no label", "use the same label for the same point in every camera."),
    (
        "fit the path that the others see",
        "check that it followed the same point, and that its lens and times are right.",
    ),
    ("no position", f"{_LONGER}."),
    ("behind a camera", f"check the lens in rig.toml; {_LONGER}."),
    ("agrees with", f"check that both followed the same point and that their lenses are right; {_LONGER}."),
    ("px", "check the lens in rig.toml and remove false detections."),
)


def remedy_for(reason: str) -> str:
    """One sentence that says what to do about a reason; it starts in lower case, to follow a name."""
    for words, remedy in _REMEDIES:
        if words in reason:
            return remedy
    return f"{_LONGER}."
