"""`rtlog-server`: the program on the vehicle."""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict

from hw_profiles.command import add_verb, run_verbs
from hw_profiles.profile import load_profile, parse_profile, read_profile_text, shipped_profiles
from rtlog_server.finding import Finding
from rtlog_server.realtime import become_realtime

COLUMNS = ("device", "", "", "found")


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
        "Ask every device how it is, watch it for some seconds, print a table; exit status 1 if something is wrong.",
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
    profile = parse_profile(text, source=args.profile)
    realtime = become_realtime()
    from rtlog_server.daemon import run  # only now: on a loaded board, real time halves what it takes to load

    run(profile, text, realtime)


def check(args: argparse.Namespace) -> int:
    from rtlog_server.check import check_devices

    logging.basicConfig(level=logging.CRITICAL)  # the table says it all
    results = check_devices(load_profile(args.profile))
    rows = [(device, finding) for device, findings in results.items() for finding in findings]
    if args.json:
        print(json.dumps([{"device": device} | asdict(finding) for device, finding in rows], indent=2))
    else:
        print(format_findings(rows))
    return 0 if all(finding.well for _, finding in rows) else 1


def format_findings(rows: Sequence[tuple[str, Finding]]) -> str:
    """A table of devices and findings; what to do next stands below what is wrong."""
    cells = [(device, f.subject, "ok" if f.well else "WRONG", f.found) for device, f in rows]
    heading, *lines = format_table([COLUMNS, *cells]).splitlines()
    advised = (f"{line}\n  -> {f.advice}" if f.advice else line for line, (_, f) in zip(lines, rows, strict=True))
    return "\n".join([heading, *advised])


def format_table(rows: Sequence[tuple[str, ...]]) -> str:
    """Rows of equal length as left-aligned columns, two spaces apart."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


if __name__ == "__main__":
    sys.exit(main())
