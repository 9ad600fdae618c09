"""What all fuzzers share: `python fuzz_X.py WAY RUNS CORPUS` tries inputs under the guidance of coverage (atheris)."""

import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import atheris


def fuzz(try_one: Callable[[bytes], None], samples: Iterable[bytes], longest: int) -> None:
    """Try RUNS inputs of up to `longest` bytes, made of the samples, which go to the folder CORPUS.

    Does not return: atheris ends the process, with an error if an input broke the law.
    """
    runs, corpus = int(sys.argv[2]), Path(sys.argv[3])
    for number, sample in enumerate(samples):
        (corpus / str(number)).write_bytes(sample)
    arguments = [
        f"-runs={runs}",
        "-seed=1",
        f"-max_len={longest}",
        "-len_control=0",
        "-timeout=5",
        "-rss_limit_mb=1000",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *arguments, str(corpus)], try_one)
    atheris.Fuzz()
