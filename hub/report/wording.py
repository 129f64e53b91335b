"""What the user moves, in words: a ball, a board, a light, a person."""

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
