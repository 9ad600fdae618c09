"""Reads that come out of a replay are counted against those that went in, with a reader that is heard in each tick."""

from compared_drive import READS, Compare, Rows, found, lose


def test_reads_may_come_together_but_not_late(compare: Compare) -> None:
    def together(out: Rows) -> None:
        out[READS, 24].reads = []
        out[READS, 25].reads[0].count = 4

    assert found(compare(together), "rfid") == []

    def late(out: Rows) -> None:
        out[READS, 23].reads = []
        together(out)
        out[READS, 25].reads[0].count = 6

    assert found(compare(late), "rfid") == [("late", 23, "")]

    def too_few(out: Rows) -> None:
        out[READS, 24].reads[0].count = 1

    assert found(compare(too_few), "rfid") == [("lost", 24, "")]

    def too_many(out: Rows) -> None:
        out[READS, 24].reads[0].count = 3

    assert found(compare(too_many), "rfid") == [("extra", 24, "")]

    def weaker(out: Rows) -> None:
        out[READS, 24].reads[0].rssi = -50.0

    assert found(compare(weaker), "rfid") == [("changed", 24, "")]


def test_a_reader_says_in_each_tick_that_it_is_there(compare: Compare) -> None:
    assert found(compare(lose(READS, 40)), "rfid") == [("silent", 40, "")]
    assert found(compare(lose(READS, 24)), "rfid") == [("lost", 24, ""), ("silent", 24, "")]
