"""What the three programs share at the command line: verbs in, an exit status out.

In: an argument parser whose subparsers each set `verb`, a function of the parsed arguments. Out: 0 done, 1 failed,
2 wrong usage or bad input, 128 + n when signal n ended it. A failure is one line on stderr, `PROGRAM: what and where`.
"""

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

from hw_profiles.errors import BadInputError, RTLogError

Verb = Callable[[argparse.Namespace], int | None]


def add_verb(verbs: Any, name: str, verb: Verb, summary: str, example: str) -> argparse.ArgumentParser:
    """A subparser for `verb` whose --help ends with an example; `verbs` is what `add_subparsers` returned."""
    raw = argparse.RawDescriptionHelpFormatter
    subparser: argparse.ArgumentParser = verbs.add_parser(
        name, help=summary, description=summary, epilog=f"example:\n  {example}", formatter_class=raw
    )
    subparser.set_defaults(verb=verb)
    return subparser


def run_verbs(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> int:
    """Parse `argv` (None: the process's own), run the verb and give the exit status; `None` from a verb means 0."""
    args = parser.parse_args(argv)
    verb: Verb | None = getattr(args, "verb", None)
    if verb is None:
        parser.error("which verb? --help lists them")
    try:
        status = verb(args) or 0
        sys.stdout.flush()  # here, so that a closed pipe is found inside the try
        return status
    except RTLogError as error:
        _complain(parser, str(error))
        return 2 if isinstance(error, BadInputError) else 1
    except KeyboardInterrupt:
        _complain(parser, "interrupted")
        return 128 + signal.SIGINT
    except BrokenPipeError:  # `… | head`: the reader has what it wanted; spare the interpreter's own flush the error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE


def _complain(parser: argparse.ArgumentParser, message: str) -> None:
    sys.stderr.write(f"{parser.prog}: {' '.join(message.split())}\n")
