"""Whoever begins in the middle is asked for the beginning, whoever leaves a gap is asked until it is closed."""

from __future__ import annotations

from dataclasses import replace

from protocols.bus.transport.backfill import (
    GAP_TIMEOUT_S,
    HISTORY_TIMEOUT_S,
    NEWEST,
    PATIENCE_S,
    RETRY_S,
    SILENCE_S,
    Backfill,
    RecoveryQuery,
)


class Stage:
    """A backfill between a recorded output and recorded questions, on a clock of its own."""

    def __init__(self) -> None:
        self.now = 0.0
        self.out: list[str] = []
        self.asked: list[RecoveryQuery[str]] = []
        self.lost = 0
        self.backfill: Backfill[str] = Backfill(
            lambda source, key, payload: self.out.append(payload.decode()),
            self.asked.append,
            self.count_lost,
            self.time,
        )

    def time(self) -> float:
        return self.now

    def count_lost(self, count: int) -> None:
        self.lost += count

    def take(self, source: str, *numbers: int) -> None:
        self.backfill.take((source, number, f"key-{source}", f"{source}{number}".encode()) for number in numbers)

    def answer(self, *numbers: int, served: bool = True) -> None:
        """The answers to the last question, and their end."""
        query = self.asked[-1]
        for number in numbers:
            self.backfill.answer(query, number, query.key, f"{query.source}{number}".encode())
        self.backfill.finish(query, served)

    def after(self, seconds: float) -> None:
        self.now += seconds
        self.backfill.poll()


def names(*numbers: int, source: str = "a") -> list[str]:
    return [f"{source}{number}" for number in numbers]


def test_who_begins_at_the_beginning_is_not_asked() -> None:
    stage = Stage()
    stage.take("a", 0, 1, 2, 3)
    assert stage.out == names(0, 1, 2, 3)
    assert stage.asked == []


def test_who_appears_is_asked_for_all_it_has() -> None:
    stage = Stage()
    stage.backfill.appeared("a", "key-a")
    assert [(q.low, q.high, q.witness) for q in stage.asked] == [(0, NEWEST, None)]
    stage.take("a", 6, 7)
    assert stage.out == [], "it waits for what came before"
    stage.answer(3, 4, 5, 6)
    assert stage.out == names(3, 4, 5, 6, 7), "each once, from the oldest that is cached"
    stage.take("a", 8)
    assert (stage.out[-1], len(stage.asked), stage.lost) == ("a8", 1, 0)


def test_who_appears_with_nothing_yet_is_heard_from_its_first_message() -> None:
    for first in (0, 5):
        stage = Stage()
        stage.backfill.appeared("a", "key-a")
        stage.answer()
        stage.take("a", first)
        if first:
            assert stage.asked[-1].high == first - 1, "nothing was there then; now there is"
            stage.answer()
        assert (stage.out, stage.lost) == (names(first), 0)


def test_who_appears_again_is_asked_for_what_is_new() -> None:
    """After an outage, of a publisher that says nothing any more: no gap shows what is missing."""
    stage = Stage()
    stage.take("a", 0, 1, 2)
    stage.backfill.appeared("a", "key-a")
    assert (stage.asked[-1].low, stage.asked[-1].high) == (3, NEWEST)
    stage.take("a", 5)
    stage.answer(3, 4)
    assert stage.out == names(0, 1, 2, 3, 4, 5)
    stage.backfill.appeared("a", "key-a")
    stage.take("a", 6)
    stage.after(SILENCE_S + 0.1)
    assert (stage.out[-1], stage.lost) == ("a6", 0), "also where no answer came"
    stage.backfill.appeared("a", "key-a")
    stage.answer(10, 11)
    assert (stage.asked[-1].low, stage.asked[-1].high, stage.asked[-1].witness) == (7, 9, 10)
    stage.answer()
    assert (stage.out[-2:], stage.lost) == (["a10", "a11"], 3), "what the cache no longer has is counted"


def test_a_reply_far_ahead_of_the_history_silences_nobody() -> None:
    stage = Stage()
    stage.backfill.appeared("a", "key-a")
    stage.take("a", 8)
    stage.answer(5, 6, 7, NEWEST - 1)
    assert stage.out == names(5, 6, 7, 8)
    stage.take("a", 9)
    stage.after(GAP_TIMEOUT_S + 0.1)
    stage.take("a", 10)
    assert stage.out == names(5, 6, 7, 8, 9, 10)


def test_what_came_before_is_fetched_once_and_put_first() -> None:
    stage = Stage()
    stage.take("a", 3, 4)
    assert [(q.key, q.source, q.low, q.high, q.witness) for q in stage.asked] == [("key-a", "a", 0, 2, 3)]
    stage.take("b", 0)
    assert stage.out == ["b0"], "others do not wait"
    stage.take("a", 5)
    stage.answer(2, 0, 1, 3)
    stage.take("a", 6)
    assert stage.out == ["b0", *names(0, 1, 2, 3, 4, 5, 6)]
    assert len(stage.asked) == 1
    assert stage.lost == 0


def test_a_late_joiner_without_an_answer_loses_nothing_but_time() -> None:
    stage = Stage()
    stage.take("a", 3)
    stage.after(0.0)
    assert stage.out == []
    stage.after(SILENCE_S + 0.1)
    assert stage.out == names(3)
    stage.answer(2)
    stage.take("a", 4)
    assert stage.out == names(3, 4), "an answer that comes too late is left out"
    assert stage.lost == 0, "nobody promised a late joiner what was before"


def test_a_gap_is_asked_for_again_when_the_question_was_lost() -> None:
    stage = Stage()
    stage.take("a", 0, 1, 5, 6)
    assert stage.out == names(0, 1)
    assert (stage.asked[0].low, stage.asked[0].high, stage.asked[0].witness) == (2, 4, 5)
    stage.answer(3, served=False)  # the connection broke
    stage.after(0.9 * RETRY_S)
    assert len(stage.asked) == 1
    stage.after(0.2 * RETRY_S)
    assert (stage.asked[1].low, stage.asked[1].high, stage.asked[1].witness) == (2, 4, 6)
    stage.answer(2, 3, 4, served=False)
    assert stage.out == names(0, 1, 2, 3, 4, 5, 6), "whole, so no witness is needed"
    assert stage.lost == 0


def test_what_the_cache_does_not_have_any_more_is_counted() -> None:
    stage = Stage()
    stage.take("a", 0, 5)
    stage.answer(3, 4)
    stage.take("a", 6)
    assert stage.out == names(0, 3, 4, 5, 6)
    assert stage.lost == 2


def test_who_ends_takes_what_is_held_back_along() -> None:
    stage = Stage()
    stage.take("a", 0, 3, 4, 7)
    stage.take("b", 9)
    stage.backfill.answer(stage.asked[0], 2, "key-a", b"a2")
    stage.backfill.answer(stage.asked[1], 8, "key-b", b"b8")
    stage.backfill.flush()
    assert stage.out == [*names(0, 2, 3, 4, 7), *names(8, 9, source="b")]
    assert stage.lost == 1 + 2
    stage.take("a", 8)
    assert stage.out[-1] == "a8"


def test_the_end_of_an_older_question_is_no_answer() -> None:
    stage = Stage()
    stage.take("a", 0, 3)
    stage.answer(served=False)
    stage.after(2 * RETRY_S)
    first, second = stage.asked
    stage.backfill.finish(first, served=True)
    assert stage.out == names(0)
    stage.backfill.finish(second, served=True)
    assert stage.out == names(0, 3)
    assert stage.lost == 2


def test_a_second_gap_while_the_first_one_waits_is_asked_for_too() -> None:
    stage = Stage()
    stage.take("a", 0, 2, 3, 6, 7)
    stage.answer(1)
    assert stage.out == names(0, 1, 2, 3)
    assert (stage.asked[1].low, stage.asked[1].high) == (4, 5)
    stage.answer(4, 5)
    stage.take("a", 8)
    assert stage.out == names(*range(9))
    assert stage.lost == 0


def test_of_many_gaps_each_is_asked_for_in_turn_and_nothing_stays_held_back() -> None:
    stage = Stage()
    stage.take("a", 0, 2, 4, 5, 8)
    for gap in ((1,), (3,), (6, 7)):
        assert (stage.asked[-1].low, stage.asked[-1].high) == (gap[0], gap[-1])
        stage.answer(*gap)
    assert stage.out == names(*range(9))
    assert stage.backfill._bytes == 0


def test_who_never_answers_holds_its_messages_up_for_a_while_only() -> None:
    stage = Stage()
    stage.take("a", 0, 3)
    stage.answer(served=False)
    while stage.now < 0.9 * GAP_TIMEOUT_S:
        stage.after(1.0)
        if len(stage.asked) < 100:
            stage.answer(served=False)
    assert stage.out == names(0)
    assert len(stage.asked) > 5
    stage.after(0.2 * GAP_TIMEOUT_S)
    assert stage.out == names(0, 3)
    assert stage.lost == 2


def test_what_comes_twice_is_left_out() -> None:
    stage = Stage()
    stage.take("a", 0, 1, 2, 1, 0, 3)
    stage.take("a", 5, 5, 4, 6)
    stage.answer(4, 4, served=False)
    assert stage.out == names(0, 1, 2, 3, 4, 5, 6)
    assert stage.lost == 0


def test_another_s_identity_on_one_s_own_key_silences_nobody() -> None:
    """One put with another camera's source id silenced that camera, with certificates too."""
    stage = Stage()
    stage.take("a", 0, 1, 2)
    stage.backfill.take([("a", 2**31, "key-forger", b"forged")])
    stage.take("a", 3, 4)
    stage.after(GAP_TIMEOUT_S + 1.0)
    stage.take("a", 5)
    assert [text for text in stage.out if text != "forged"] == names(0, 1, 2, 3, 4, 5)


def test_a_forged_number_on_one_s_key_delays_and_silences_nobody() -> None:
    """Where anyone may publish on any key: the numbers that continue are the publisher's."""
    stage = Stage()
    stage.take("a", 0, 1, 2)
    stage.take("a", 1_000_000)
    stage.take("a", 3, 4)
    assert stage.out == names(0, 1, 2, 3, 4)
    stage.answer(served=False)
    stage.after(GAP_TIMEOUT_S + 1.0)
    stage.take("a", 5, 6)
    assert stage.out == names(0, 1, 2, 3, 4, 5, 6)
    assert stage.lost == 0


def test_a_gap_whose_messages_arrive_late_is_closed_by_them() -> None:
    stage = Stage()
    stage.take("a", 0, 3, 4, 1, 2, 5)
    assert stage.out == names(0, 1, 2, 3, 4, 5)


def test_replies_on_another_key_are_left_out() -> None:
    stage = Stage()
    stage.take("a", 0, 2)
    stage.backfill.answer(stage.asked[-1], 1, "key-forger", b"forged")
    assert "forged" not in stage.out
    stage.answer(1)
    assert stage.out == names(0, 1, 2)


def test_invented_publishers_of_one_key_are_forgotten_first() -> None:
    stage = Stage()
    stage.take("a", 0, 1)
    for number in range(1000):
        stage.backfill.take([(f"x{number}", 0, "key-forger", b"forged")])
    assert len(stage.backfill._next) < 20
    stage.take("a", 2)
    assert stage.out[-1] == "a2"


def test_a_forged_number_while_a_publisher_is_asked_silences_nobody() -> None:
    for cached in ((), range(495, 500)):
        stage = Stage()
        stage.backfill.appeared("a", "key-a")
        stage.take("a", 2**31 - 5)
        stage.take("a", 500, 501)
        stage.answer(*cached)
        stage.take("a", 502)
        stage.after(GAP_TIMEOUT_S + 0.1)
        stage.take("a", 503)
        delivered = [name for name in stage.out if int(name[1:]) < 1000]
        assert delivered == names(*cached, *range(500, 504))


def test_a_forged_number_before_the_first_message_silences_nobody() -> None:
    """A receiver that restarts, and hears a forged number first, took the camera's own messages for old ones."""
    stage = Stage()
    stage.take("a", 2**31)  # forged, with the camera's own source id
    stage.take("a", 500, 501)
    stage.take("a", 2**31 + 1)
    stage.after(0.5)
    stage.answer(*range(495, 500))  # what the camera's cache still has
    stage.take("a", 502)
    stage.after(GAP_TIMEOUT_S + 0.1)
    stage.take("a", 503, 504)
    delivered = [name for name in stage.out if int(name[1:]) < 2**31]
    assert delivered == names(*range(495, 505))


def test_a_forged_number_alone_does_not_outlast_what_the_camera_has_published() -> None:
    stage = Stage()
    stage.take("a", 2**31)
    stage.answer(0, 1, 2)
    stage.take("a", 3, 4)
    assert stage.out == names(0, 1, 2, 3, 4)


def test_a_history_is_fetched_in_parts_the_newest_first() -> None:
    stage = Stage()
    stage.backfill.appeared("a", "key-a")
    stage.take("a", 656)
    stage.answer(*range(144, 656))
    assert (stage.out, [query.high for query in stage.asked]) == ([], [NEWEST, 143])
    stage.answer(*range(100, 120), served=False)
    stage.after(RETRY_S)
    assert [query.high for query in stage.asked] == [NEWEST, 143, 143], "a part whose time is up is asked for again"
    stage.answer(*range(100, 144))
    assert (stage.out, len(stage.asked), stage.lost) == (names(*range(100, 657)), 3, 0)


def test_what_was_fetched_of_a_history_whose_time_is_up_continues_in_what_comes_by_itself() -> None:
    stage = Stage()
    stage.backfill.appeared("a", "key-a")
    stage.take("a", 656)
    stage.answer(*range(144, 656))
    stage.after(HISTORY_TIMEOUT_S + 0.1)
    stage.take("a", 657)
    assert (stage.out, stage.lost) == (names(*range(144, 658)), 0)


def test_a_history_without_an_answer_of_which_messages_come_is_asked_for_again() -> None:
    """Of a connection that broke, Zenoh reports only that there are no more replies."""
    stage = Stage()
    stage.backfill.appeared("a", "key-a")
    stage.take("a", 8, 9)
    stage.answer()
    assert [query.witness for query in stage.asked] == [None, 9]
    stage.answer(served=False)
    stage.after(RETRY_S)
    stage.answer(6, 7, 8, 9)
    assert stage.out == names(6, 7, 8, 9)


def test_a_history_that_ends_with_a_part_is_not_asked_for_more() -> None:
    stage = Stage()
    stage.take("a", 512)
    stage.answer(*range(512))
    assert (stage.out, len(stage.asked)) == (names(*range(513)), 1)


def test_the_last_message_before_a_pause_is_asked_for_by_its_heartbeats() -> None:
    stage = Stage()
    stage.take("a", 0, 1)
    stage.backfill.heartbeat("a", "key-a", 3)
    assert stage.asked == [], "it may be on its way"
    stage.now += PATIENCE_S
    stage.backfill.heartbeat("a", "key-a", 3)
    assert [(q.low, q.high, q.witness) for q in stage.asked] == [(2, 3, 3)]
    stage.answer(served=False)
    stage.after(RETRY_S)
    assert (len(stage.asked), stage.lost) == (2, 0), "a connection that breaks loses nothing"
    stage.take("a", 4)
    stage.answer(2, 3)
    assert (stage.out, stage.lost) == (names(0, 1, 2, 3, 4), 0)


def test_who_has_sent_all_that_its_heartbeats_announce_is_not_asked() -> None:
    stage = Stage()
    stage.take("a", 0)
    for number in range(1, 5):  # each arrives after the heartbeat that announces it
        stage.backfill.heartbeat("a", "key-a", number)
        stage.take("a", number)
        stage.now += PATIENCE_S
        stage.backfill.heartbeat("a", "key-a", number)
    assert stage.asked == []


def test_who_had_nothing_when_it_appeared_is_asked_again_at_its_heartbeats() -> None:
    stage = Stage()
    stage.backfill.appeared("a", "key-a")
    stage.answer()
    stage.backfill.heartbeat("a", "key-a", 2)
    stage.answer(0, 1, 2)
    assert stage.out == names(0, 1, 2)


def test_a_forged_heartbeat_loses_and_silences_nothing() -> None:
    stage = Stage()
    stage.take("a", 0, 1)
    for _ in range(2):
        stage.backfill.heartbeat("a", "key-a", 2**31)
        stage.now += PATIENCE_S
    stage.after(GAP_TIMEOUT_S + 1.0)
    stage.take("a", 2, 3)
    assert (stage.out, stage.lost) == (names(0, 1, 2, 3), 0)


def test_of_a_part_that_broke_off_nothing_is_lost_by_a_smaller_one() -> None:
    """A cache answers in ascending order: what came of the larger part is its old end."""
    stage = Stage()
    stage.take("a", 0, 601)
    query = stage.asked[-1]
    for number in range(89, 120):
        stage.backfill.answer(query, number, query.key, f"a{number}".encode())
    stage.backfill.finish(query, served=False)
    stage.after(RETRY_S)
    while len(stage.out) == 1:
        query = replace(stage.asked[-1], most=256)
        for number in range(max(query.high - 255, query.low), query.high + 1):
            stage.backfill.answer(query, number, query.key, f"a{number}".encode())
        stage.backfill.finish(query, served=True)
    assert (stage.out, stage.lost) == (names(*range(602)), 0)


def test_a_gap_is_fetched_in_parts_the_newest_first() -> None:
    stage = Stage()
    stage.take("a", 0, 601)
    most = stage.asked[-1].most
    assert most is not None
    stage.answer(*range(600, 600 - most, -1))
    assert [(q.low, q.high) for q in stage.asked] == [(1, 600), (1, 600 - most)]
    stage.answer(*range(600 - most, 600 - 2 * most, -1))
    stage.answer(*range(600 - 2 * most, 0, -1))
    assert (stage.out, stage.lost) == (names(*range(602)), 0)
