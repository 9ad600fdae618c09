"""Work on independent items, here or in several processes: the results do not depend on where.

In: a function and its items. Out: the results in the order of the items. Law: when the work ends early, by Ctrl-C,
SIGTERM or an error, the processes end at once and without a word.

The processes are forked when there is first something to do: they have all modules at once, where a fresh Python takes
a second to load them. So a program that has threads of its own must not ask for more than one job.
"""

import ctypes
import gc
import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import Any, Self, TypeVar

from tqdm import tqdm

from hw_profiles.errors import RTLogError

PR_SET_PDEATHSIG = 1  # of Linux
tqdm.monitor_interval = 0  # else it would keep a thread, and threads do not get along with forks

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers:
    """`jobs` processes, or with one job this one."""

    def __init__(self, jobs: int) -> None:
        if jobs > 1:
            gc.freeze()  # what is there stays: who is forked need neither look at it nor copy it
        fork = multiprocessing.get_context("fork")
        self._pool = ProcessPoolExecutor(jobs, fork, _end_with_the_program) if jobs > 1 else None
        self._jobs = jobs

    def begin(
        self, label: str, function: Callable[[Item], Result], items: Iterable[Item], at_once: int = 1
    ) -> Iterator[Result]:
        """The results, in order. Other processes are at work on them from now on; small ones go there `at_once`.

        Raises: RTLogError: a process died; whatever `function` raises.
        """
        items = list(items)
        if self._pool is None or len(items) < 2:
            results: Iterator[Result] = map(function, items)
        else:
            chunk = max(1, min(at_once, len(items) // (4 * self._jobs)), len(items) // (32 * self._jobs))
            with _deaf_children():
                results = self._pool.map(function, items, chunksize=chunk)
        return _told(tqdm(results, total=len(items), desc=label, disable=None, leave=False))

    def map(
        self, label: str, function: Callable[[Item], Result], items: Iterable[Item], at_once: int = 1
    ) -> list[Result]:
        """As `begin`, all of them."""
        return list(self.begin(label, function, items, at_once))

    def starmap(
        self, label: str, function: Callable[..., Result], items: Iterable[tuple[Any, ...]], at_once: int = 1
    ) -> list[Result]:
        """The same; every item holds all arguments."""
        return self.map(label, partial(_apply, function), items, at_once)

    def map_groups(
        self, label: str, function: Callable[[Item], Result], groups: Iterable[Iterable[Item]]
    ) -> list[list[Result]]:
        """The same for groups of items, which are done all together: the results of each group."""
        return list(self.begin_groups(label, function, groups))

    def begin_groups(
        self, label: str, function: Callable[[Item], Result], groups: Iterable[Iterable[Item]]
    ) -> Iterator[list[Result]]:
        """As `begin`, of groups."""
        listed = [list(group) for group in groups]
        results = self.begin(label, function, [item for group in listed for item in group])
        return (list(islice(results, len(group))) for group in listed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is None:
            return
        if kind is not None:  # else the pool would first finish what it has begun, which can take minutes
            for process in multiprocessing.active_children():
                process.kill()
        self._pool.shutdown(cancel_futures=True)


def _told(results: Iterator[Result]) -> Iterator[Result]:
    try:
        yield from results
    except BrokenProcessPool as error:
        raise RTLogError("a process died, perhaps for want of memory; try fewer --jobs") from error


def _apply(function: Callable[..., Result], arguments: tuple[Any, ...]) -> Result:
    return function(*arguments)


def _end_with_the_program() -> None:
    """What the program does at SIGTERM is not for its processes; and where it is killed, they end."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


@contextmanager
def _deaf_children() -> Iterator[None]:
    """A terminal sends Ctrl-C to every process of a program, and one answers: those born in here are deaf to it."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
