"""Words for the user: what is moved (a ball, a board, a light, a person), and what can be done about a refusal."""

from __future__ import annotations

from protocols.session.rig import Rig

ANY = "target"
"""What the user moves, where nobody says what it is."""
VERBS = {
    "ball": "wave it",
    "board": "show it",
    "tag": "show it",
    "light": "move it",
    "person": "walk",
    "vehicle": "drive",
}
"""What the user does with the target, by its name."""

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


def target_of(rig: Rig, labels: list[str]) -> str:
    """What the user moves, in one word: as the session or the only label says, a board where there are bodies, a person
    with joints."""
    given = rig.metadata.get("target", labels[0] if len(labels) == 1 else None)
    if isinstance(given, str) and given in VERBS:
        return given
    if rig.bodies:
        return "board" if max(len(body) for body in rig.bodies.values()) > 4 else "tag"
    return "person" if any(label.endswith(("hip", "knee", "shoulder", "head", "foot")) for label in labels) else ANY


def in_words_of(text: str, rig: Rig, labels: list[str]) -> str:
    """A text on "the point", which says what the user moves instead, where that is known."""
    word = target_of(rig, labels)
    for article in ("the", "The", "this") if word != ANY else ():
        text = text.replace(f"{article} point", f"{article} {word}")
    return text


def remedy_for(reason: str) -> str:
    """One sentence on what to do about a reason; it starts in lower case, to follow a camera name."""
    for words, remedy in _REMEDIES:
        if words in reason:
            return remedy
    return f"{_LONGER}."
