"""Whoever begins in the middle is asked for the beginning, and everything comes out in order."""

from __future__ import annotations

from protocols.bus.backfill import PATIENCE_S, Backfill


class Stage:
    """A backfill between a recorded output and recorded requests, on a clock of its own."""

    def __init__(self) -> None:
        self.now = 0.0
        self.out: list[bytes] = []
        self.asked: list[tuple[str, str, int]] = []
        self.backfill: Backfill[str] = Backfill(
            lambda source, key, payload: self.out.append(payload),
            lambda key, source, first: self.asked.append((key, source, first)),
            lambda: self.now,
        )

    def take(self, source: str, *numbers: int) -> None:
        for number in numbers:
            self.backfill.take(source, number, f"key-{source}", f"{source}{number}".encode())

    def answer(self, source: str, *numbers: int) -> None:
        for number in numbers:
            self.backfill.answer(source, number, f"key-{source}", f"{source}{number}".encode())


def test_who_begins_at_the_beginning_is_not_asked() -> None:
    stage = Stage()
    stage.take("a", 0, 1, 2, 7)
    assert stage.out == [b"a0", b"a1", b"a2", b"a7"]
    assert stage.asked == []


def test_what_came_before_is_fetched_once_and_put_first() -> None:
    stage = Stage()
    stage.take("a", 3, 4)
    assert stage.asked == [("key-a", "a", 3)]
    stage.take("b", 0)
    assert stage.out == [b"b0"], "others do not wait"
    stage.answer("a", 2, 0, 1, 3)
    stage.take("a", 5)
    stage.backfill.finish("a")
    stage.take("a", 6)
    assert stage.out == [b"b0", b"a0", b"a1", b"a2", b"a3", b"a4", b"a5", b"a6"]
    assert len(stage.asked) == 1


def test_no_answer_costs_nothing_but_time() -> None:
    stage = Stage()
    stage.take("a", 3)
    stage.backfill.release_overdue()
    assert stage.out == []
    stage.now = PATIENCE_S + 0.1
    stage.backfill.release_overdue()
    assert stage.out == [b"a3"]
    stage.answer("a", 2)
    stage.backfill.finish("a")
    stage.take("a", 4)
    assert stage.out == [b"a3", b"a4"], "an answer that comes too late is left out"
