"""Which positions make a reading, and when the driver is called."""

from rtlog_server.devices.cia406.rounds import MARGIN_NS, SyncRounds, TimerRounds
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import Fix

GRID = TickGrid(0, 100_000_000)
MS = 1_000_000


def sync_rounds() -> SyncRounds:
    rounds = SyncRounds(GRID, sync_wire_ns=94_000, reply_wire_ns=0)
    for name in ("left", "right"):
        rounds.join(name)
    return rounds


def test_sync_goes_out_so_early_that_all_replies_are_in_by_the_tick() -> None:
    rounds = sync_rounds()
    at_ns = rounds.next_ns(1 * MS)
    assert at_ns == 100 * MS - rounds.lead_ns
    assert rounds.step(at_ns) is None  # which means SYNC
    rounds.sent(at_ns)
    assert rounds.add("left", 7, at_ns + MS) is None
    fixes = rounds.add("right", 8, at_ns + 2 * MS)
    latched_ns = at_ns + 94_000
    assert fixes == {"left": Fix(7, latched_ns, at_ns + MS), "right": Fix(8, latched_ns, at_ns + 2 * MS)}
    assert at_ns + 2 * MS < 100 * MS
    assert rounds.next_ns(at_ns + 2 * MS) == 200 * MS - rounds.lead_ns


def test_the_lead_follows_the_time_that_replies_take() -> None:
    rounds = sync_rounds()
    now_ns = 0
    for _ in range(60):
        now_ns = rounds.next_ns(now_ns)
        rounds.step(now_ns)
        rounds.sent(now_ns)
        rounds.add("left", 0, now_ns + 3 * MS)
        now_ns += 9 * MS
        rounds.add("right", 0, now_ns)
    assert abs(rounds.lead_ns - (9 * MS + MARGIN_NS)) < MS / 4


def test_a_silent_encoder_is_waited_for_once_and_counted_in_when_it_answers() -> None:
    rounds = sync_rounds()
    at_ns = rounds.next_ns(0)
    rounds.sent(at_ns)
    assert rounds.add("left", 1, at_ns + MS) is None
    overdue_ns = rounds.next_ns(at_ns + MS)
    assert at_ns < overdue_ns < at_ns + 100 * MS
    fixes = rounds.step(overdue_ns)
    assert fixes is not None
    assert set(fixes) == {"left"}
    at_ns = rounds.next_ns(overdue_ns)
    assert at_ns == 200 * MS - rounds.lead_ns
    rounds.sent(at_ns)
    assert set(rounds.add("left", 2, at_ns + MS) or {}) == {"left"}
    assert rounds.add("right", 3, at_ns + 2 * MS) is None  # it came after the round
    rounds.join("right")
    at_ns = rounds.next_ns(at_ns + 3 * MS)
    rounds.sent(at_ns)
    assert rounds.add("left", 2, at_ns + MS) is None


def test_an_encoder_that_answers_first_makes_the_round_whole_again() -> None:
    rounds = sync_rounds()
    rounds.sent(rounds.next_ns(0))
    rounds.add("left", 1, 95 * MS)
    rounds.step(rounds.next_ns(95 * MS))
    at_ns = rounds.next_ns(150 * MS)
    rounds.sent(at_ns)
    assert rounds.add("right", 1, at_ns + MS) is None
    assert set(rounds.add("left", 1, at_ns + 2 * MS) or {}) == {"left", "right"}


def test_an_answer_that_comes_twice_is_noticed_and_the_first_one_counts() -> None:
    rounds = sync_rounds()
    at_ns = rounds.next_ns(0)
    rounds.sent(at_ns)
    rounds.add("left", 1, at_ns + MS)
    rounds.add("left", 900, at_ns + MS)
    assert rounds.answered_twice == {"left"}
    fixes = rounds.add("right", 2, at_ns + MS)
    assert fixes is not None
    assert fixes["left"].raw == 1
    rounds.add("right", 900, at_ns + MS)  # after the round
    assert rounds.answered_twice == {"left", "right"}
    rounds.sent(rounds.next_ns(at_ns + 2 * MS))
    rounds.answered_twice.clear()
    rounds.add("left", 3, at_ns + 100 * MS)
    assert not rounds.answered_twice


def test_after_a_long_sleep_sync_keeps_to_the_grid() -> None:
    rounds = sync_rounds()
    rounds.next_ns(0)
    at_ns = rounds.next_ns(123_456 * MS)
    assert at_ns == 123_500 * MS - rounds.lead_ns


def test_by_timer_the_newest_position_of_each_is_taken_and_a_stale_one_left_out() -> None:
    rounds = TimerRounds(GRID, position_wire_ns=222_000, timer_ns=10 * MS)
    at_ns = rounds.next_ns(0)
    assert at_ns == 100 * MS - MARGIN_NS
    rounds.add("left", 1, at_ns - 12 * MS)
    rounds.add("left", 2, at_ns - 2 * MS)
    rounds.add("right", 3, at_ns - 7 * MS)
    fixes = rounds.step(at_ns)
    assert fixes["left"] == Fix(2, at_ns - 2 * MS - 222_000, at_ns - 2 * MS)
    assert fixes["right"].raw == 3
    at_ns = rounds.next_ns(at_ns)
    assert at_ns == 200 * MS - MARGIN_NS
    rounds.add("right", 4, at_ns - 5 * MS)
    assert set(rounds.step(at_ns)) == {"right"}
