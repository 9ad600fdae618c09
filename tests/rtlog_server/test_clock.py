"""The device clock is followed to within a millisecond, whatever the network does to the deliveries."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from rtlog_server.clock import WRAP_US, DeviceClock, lower_line

PERIOD_NS = 20_100_000
MS = 1_000_000
S = 1_000_000_000


def deliveries(
    rng: np.random.Generator, count: int, drift_ppm: float = 50.0, first_us: int = 0, period_ns: int = PERIOD_NS
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Counts (u32), times of reception and the true times, of events at even times.

    Delays: 0.1 ms, an exponential jitter of 0.5 ms, and 20 ms on every twentieth; a connection keeps the order.
    """
    true_ns = 5 * S + np.arange(count) * period_ns
    device_us = (first_us + (true_ns - true_ns[0]) * (1 + drift_ppm * 1e-6) / 1000).astype(np.int64)
    delay_ns = 100_000 + rng.exponential(0.5 * MS, count) + 20 * MS * (rng.random(count) < 0.05)
    receive_ns = np.maximum.accumulate(true_ns + delay_ns.astype(np.int64))
    return device_us % WRAP_US, receive_ns, true_ns


def follow(clock: DeviceClock, device_us: NDArray[np.int64], receive_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    pairs: Iterator[tuple[int, int]] = zip(device_us.tolist(), receive_ns.tolist(), strict=True)
    return np.array([clock.update(us, ns) for us, ns in pairs])


@pytest.mark.parametrize("drift_ppm", [-100.0, 0.0, 50.0])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("period_ns", [PERIOD_NS, 100 * MS])
def test_within_a_millisecond_of_the_truth(drift_ppm: float, seed: int, period_ns: int) -> None:
    device_us, receive_ns, true_ns = deliveries(np.random.default_rng(seed), 8000, drift_ppm, period_ns=period_ns)
    error_ns = np.abs(follow(DeviceClock(), device_us, receive_ns) - true_ns)
    assert np.percentile(error_ns, 99) < 1 * MS
    assert np.percentile(error_ns[-4000:], 99) < 0.3 * MS
    assert error_ns[50:].max() < 2 * MS


def test_a_wrap_leaves_no_trace() -> None:
    rng = np.random.default_rng(1)
    unwrapped = follow(DeviceClock(), *deliveries(rng, 4000)[:2])
    rng = np.random.default_rng(1)
    wrapped = follow(DeviceClock(), *deliveries(rng, 4000, first_us=WRAP_US - 40_000_000)[:2])
    assert np.abs(wrapped - unwrapped).max() < 2000  # the count itself is cut to microseconds


def test_never_later_than_the_reception() -> None:
    device_us, receive_ns, _ = deliveries(np.random.default_rng(2), 8000)
    assert (follow(DeviceClock(), device_us, receive_ns) <= receive_ns).all()


def test_usable_from_the_first_count_and_without_steps() -> None:
    device_us, receive_ns, true_ns = deliveries(np.random.default_rng(3), 3000)
    host_ns = follow(DeviceClock(), device_us, receive_ns)
    assert host_ns[0] == receive_ns[0]
    error_ns = (host_ns - true_ns)[5:]  # by then some delivery was a fast one
    assert np.abs(np.diff(error_ns)).max() < 0.5 * MS


def test_a_restarted_device_starts_anew() -> None:
    device_us, receive_ns, true_ns = deliveries(np.random.default_rng(4), 6000, first_us=50_000_000)
    off = 3000
    device_us[off:] -= device_us[off] - 8_000_000  # it booted for 8 s, unseen: all counts lie 8 … 68 s after power-up
    receive_ns[off:] += 30 * S
    true_ns[off:] += 30 * S
    error_ns = np.abs(follow(DeviceClock(), device_us, receive_ns) - true_ns)
    assert np.percentile(error_ns, 99) < 1 * MS


def test_a_restart_that_looks_like_a_step_ahead() -> None:
    # The count stood 22 s before its wrap and falls to 8 s, as it would have done in 30 s; it was away for 60 s.
    device_us, receive_ns, true_ns = deliveries(
        np.random.default_rng(4), 4000, first_us=WRAP_US - 22_000_000 - 40_200_000
    )
    device_us[2000:] = (device_us[2000:] - device_us[2000]) % WRAP_US + 8_000_000
    receive_ns[2000:] += 60 * S
    true_ns[2000:] += 60 * S
    error_ns = np.abs(follow(DeviceClock(), device_us, receive_ns) - true_ns)
    assert np.percentile(error_ns, 99) < 1 * MS


def test_the_clock_is_kept_through_an_outage_longer_than_a_wrap() -> None:
    device_us, receive_ns, true_ns = deliveries(np.random.default_rng(5), 3000)
    gap_ns = 2 * 3600 * S
    device_us[2000:] = (device_us[2000:] + round(gap_ns * (1 + 50e-6) / 1000)) % WRAP_US
    receive_ns[2000:] += gap_ns
    true_ns[2000:] += gap_ns
    error_ns = np.abs(follow(DeviceClock(), device_us, receive_ns) - true_ns)
    assert np.percentile(error_ns, 99) < 1 * MS


def test_a_host_that_stood_still_does_not_look_like_a_restart() -> None:
    device_us, receive_ns, true_ns = deliveries(np.random.default_rng(6), 3000)
    receive_ns[1500:1600] = receive_ns[1600]  # 2 s of telegrams read in one go
    error_ns = np.abs(follow(DeviceClock(), device_us, receive_ns) - true_ns)
    assert np.percentile(error_ns, 99) < 1 * MS


@pytest.mark.parametrize("wrong_us", [5_000_000, -5_000_000, 200_000, -200_000, 2**31, 9_999_999])
def test_a_garbled_count_spoils_no_other(wrong_us: int) -> None:
    device_us, receive_ns, true_ns = deliveries(np.random.default_rng(8), 3000)
    device_us[1500] = (device_us[1500] + wrong_us) % WRAP_US
    error_ns = np.abs(follow(DeviceClock(), device_us, receive_ns) - true_ns)
    error_ns[1500] = 0  # which had no true one to tell
    assert np.percentile(error_ns, 99) < 1 * MS
    assert error_ns[1550:].max() < 1 * MS


def test_the_line_lies_under_all_points_and_is_the_nearest() -> None:
    rng = np.random.default_rng(7)
    time_s = np.sort(rng.uniform(0, 60, 40))
    delay_ns = 20_000.0 * time_s + rng.exponential(1e6, 40)
    slope, intercept = lower_line(list(zip(time_s.tolist(), delay_ns.tolist(), strict=True)), 0.0)
    height = delay_ns - slope * time_s - intercept
    assert height.min() > -1e-3
    for i in range(40):  # brute force: of all lines through two points that lie under the rest, none is nearer in sum
        for k in range(i):
            other = (delay_ns[i] - delay_ns[k]) / (time_s[i] - time_s[k])
            above = delay_ns - delay_ns[i] - other * (time_s - time_s[i])
            if above.min() > -1e-3:
                assert above.sum() >= height.sum() - 1e-3
