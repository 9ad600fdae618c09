"""Work on independent items, here or in several processes: the results do not depend on where.

In: a function and its items. Out: the results in the order of the items. Law: when the work ends early, by Ctrl-C,
SIGTERM or an error, the processes end at once and without a word.
"""

import multiprocessing
import signal
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Self, TypeVar

from tqdm import tqdm

from hw_profiles.errors import RTLogError

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers:
    """`jobs` processes, or with one job this one."""

    def __init__(self, jobs: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(jobs, context) if jobs > 1 else None

    def map(self, label: str, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Raises: RTLogError: a process died; whatever `function` raises."""
        items = list(items)
        bar = partial(tqdm, total=len(items), desc=label, disable=None, leave=False)
        if self._pool is None or len(items) < 2:
            return [function(item) for item in bar(items)]
        # A terminal sends Ctrl-C to every process of a program, and one answers: the others are born deaf to it.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            results = self._pool.map(function, items)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        try:
            return list(bar(results))
        except BrokenProcessPool as error:
            raise RTLogError("a process died, perhaps for want of memory; try fewer --jobs") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is None:
            return
        if kind is not None:  # else the pool would first finish what it has begun, which can take minutes
            for process in multiprocessing.active_children():
                process.kill()
        self._pool.shutdown(cancel_futures=True)
