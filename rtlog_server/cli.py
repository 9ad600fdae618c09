"""`rtlog-server`: the program on the vehicle."""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict

from hw_profiles.command import add_verb, run_verbs
from hw_profiles.profile import load_profile, parse_profile, read_profile_text, shipped_profiles
from rtlog_server.check import CheckResult, check_devices
from rtlog_server.daemon import run

COLUMNS = ("device", "address", "reachable", "identity", "what to do next")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb; the exit status: 0 done, 1 failed, 2 wrong usage or bad input."""
    parser = argparse.ArgumentParser(prog="rtlog-server", description="Samples the sensors of a vehicle, on zenoh.")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB")
    run_parser = add_verb(
        verbs,
        "run",
        run_server,
        "Sample every tick and publish, until Ctrl-C or SIGTERM. A device that is away is tried again and again.",
        "rtlog-server run --profile canmet_trailer",
    )
    run_parser.add_argument("--verbose", action="store_true", help="tell more on stderr")
    check_parser = add_verb(
        verbs,
        "check",
        check,
        "Try every device for a few seconds and print a table; exit status 1 if one is not well.",
        "rtlog-server check --profile canmet_trailer",
    )
    check_parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    for subparser in (run_parser, check_parser):
        subparser.add_argument(
            "--profile", required=True, metavar="P", help=f"a file, or one of: {', '.join(shipped_profiles())}"
        )
    return run_verbs(parser, argv)


def run_server(args: argparse.Namespace) -> None:
    level = logging.DEBUG if args.verbose else logging.INFO
    logging.basicConfig(stream=sys.stderr, level=level, format="%(asctime)s %(levelname)s %(message)s")
    text = read_profile_text(args.profile)
    run(parse_profile(text, source=args.profile), text)


def check(args: argparse.Namespace) -> int:
    logging.basicConfig(level=logging.CRITICAL)  # the table says it all
    results = check_devices(load_profile(args.profile))
    if args.json:
        print(json.dumps([asdict(result) for result in results], indent=2))
    else:
        print(format_table([COLUMNS, *map(_row, results)]))
    return 0 if all(result.reachable for result in results) else 1


def _row(result: CheckResult) -> tuple[str, ...]:
    identity = ", ".join(f"{key} {value}" for key, value in result.identity.items())
    next_step = f"{result.message}: {result.advice}" if result.advice else ""
    return result.device, result.address, "yes" if result.reachable else "no", identity, next_step


def format_table(rows: Sequence[tuple[str, ...]]) -> str:
    """Rows of equal length as left-aligned columns, two spaces apart."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


if __name__ == "__main__":
    sys.exit(main())
