"""rtlog-client record | recover | audit | replay | compare: the laptop's commands. Only here is anything printed."""

import argparse
import json
import logging
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from hw_profiles.command import add_verb, run_verbs
from hw_profiles.errors import BadInputError
from hw_profiles.profile import parse_profile, read_profile_text
from rtlog_client.audit import audit
from rtlog_client.compare import compare_recordings
from rtlog_client.faults import load_faults
from rtlog_client.live_line import LiveLine
from rtlog_client.log_file import read_info
from rtlog_client.record import record
from rtlog_client.recorder import DEFAULT_ENDPOINT, RecordConfig
from rtlog_client.recover import recover
from rtlog_client.replay import NO_FAULTS, serve_devices
from rtlog_client.replay_capture import serve_capture
from rtlog_client.replay_report import load_report
from rtlog_client.republish import republish

DEVICE_HELP = "RUN is a captured byte stream of this scanner, as laser/primary; its very bytes are sent"
RATE_HELP = "so many times as fast, or max: one recorded tick for each tick of the profile; default: 1"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="rtlog-client", description="Records, mends, checks and replays drives.")
    verbs = parser.add_subparsers(metavar="VERB")

    verb = add_verb(verbs, "record", _record, "record what a server publishes", "rtlog-client record -o recordings")
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the recordings")
    verb.add_argument("--connect", default=DEFAULT_ENDPOINT, metavar="ENDPOINT", help="default: %(default)s")
    verb.add_argument("--vehicle", help="default: the only one there")
    verb.add_argument("--name", metavar="STEM", help="of the file; default: UTC date and vehicle")
    verb.add_argument("--duration", type=_seconds, metavar="S", help="stop so long after the first tick")
    verb.add_argument("--json", action="store_true", help="the summary as JSON")

    example = "rtlog-client recover recordings/20260304T071500Z_canmet_trailer.mcap.part"
    verb = add_verb(verbs, "recover", _recover, "mend a recording that was cut off or damaged", example)
    verb.add_argument("recording", type=Path, metavar="FILE", help="NAME.mcap.part or NAME.mcap; it is only read")
    verb.add_argument("-o", "--output", type=Path, metavar="OUT.mcap", help="default: NAME.mcap, NAME.recovered.mcap")
    verb.add_argument("--json", action="store_true", help="what came back as JSON")

    example = "rtlog-client audit recordings/20260304T071500Z_canmet_trailer.mcap"
    verb = add_verb(verbs, "audit", _audit, "check a recording against the contract; status 1 if it breaks it", example)
    verb.add_argument("recording", type=Path, metavar="RUN.mcap")
    verb.add_argument("--json", action="store_true", help="all of it as JSON")

    example = "rtlog-client replay recordings/a.mcap --to devices --profile simulated"
    verb = add_verb(verbs, "replay", _replay, "play a recording to the device emulators or on zenoh", example)
    verb.add_argument("recording", type=Path, metavar="RUN")
    verb.add_argument("--to", choices=("zenoh", "devices"), required=True, help="publish it, or be its devices")
    verb.add_argument(
        "--profile", default="simulated", metavar="P", help="says at which addresses; default: %(default)s"
    )
    verb.add_argument("--start", type=_start, default=0.0, metavar="S", help="so long after the recording's start")
    verb.add_argument("--duration", type=_seconds, metavar="S", help="default: to the end")
    verb.add_argument("--rate", type=_rate, default=1.0, metavar="R", help=f"to devices: {RATE_HELP}")
    verb.add_argument("--device", metavar="NAME", help=f"to devices: {DEVICE_HELP}")
    verb.add_argument("--faults", type=Path, metavar="FILE.toml", help="to devices: what goes wrong at the wire, when")

    example = "rtlog-client compare recordings/a.mcap recordings/a_again.mcap --replay replay.json"
    summary = "is what came out of a replay to devices what went in? status 1 if not, and no fault explains it"
    verb = add_verb(verbs, "compare", _compare, summary, example)
    verb.add_argument("went_in", type=Path, metavar="IN.mcap")
    verb.add_argument("came_out", type=Path, metavar="OUT.mcap")
    replay_help = "what the replay printed: its clock and its faults; default: both have one clock"
    verb.add_argument("--replay", type=Path, metavar="REPORT.json", help=replay_help)
    verb.add_argument("--json", action="store_true", help="every difference as JSON")

    return run_verbs(parser, argv)


def _number(text: str) -> float:
    """NaN for what is no number: it lies within no bounds."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _seconds(text: str) -> float:
    seconds = _number(text)
    if not 0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is no number of seconds above 0")
    return seconds


def _rate(text: str) -> float | None:
    if text == "max":
        return None
    rate = _number(text)
    if not 0 < rate < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is neither max nor a number above 0")
    return rate


def _start(text: str) -> float:
    seconds = _number(text)
    if not 0 <= seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is no number of seconds from 0 on")
    return seconds


def _stop_on_signals() -> threading.Event:
    """Set at the first SIGINT or SIGTERM; the next one ends the program the hard way."""
    stopping = threading.Event()

    def stop(number: int, _frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        stopping.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stopping


def _log_to_stderr(prefix: str = "") -> None:
    logging.basicConfig(format=f"{prefix}%(message)s", level=logging.INFO, stream=sys.stderr, force=True)


def _record(args: argparse.Namespace) -> None:
    line = LiveLine(sys.stderr)
    _log_to_stderr(line.clear)
    config = RecordConfig(args.output, args.connect, args.vehicle, args.name, args.duration)
    summaries = record(config, _stop_on_signals(), line.show)
    if args.json:
        print(json.dumps([{**asdict(s), "path": str(s.path)} for s in summaries]))
        return
    for summary in summaries:
        print(f"{summary.path}  {summary.ticks} ticks  {summary.size_bytes / 1e6:.1f} MB")
        for topic, count in summary.messages.items():
            print(f"  {topic:24}{count:9} messages{summary.lost.get(topic, 0):9} lost")


def _recover(args: argparse.Namespace) -> None:
    total = args.recording.stat().st_size if args.recording.is_file() else 0
    with tqdm(total=total, unit="B", unit_scale=True, delay=1.0, disable=None, leave=False) as bar:
        recovery = recover(args.recording, args.output, lambda position: bar.update(position - bar.n))
    if args.json:
        print(json.dumps({**asdict(recovery), "path": str(recovery.path)}))
        return
    count = sum(recovery.messages.values())
    print(f"{recovery.path}: {count} messages; {args.recording} is left as it is")
    if recovery.was_whole:
        print("  it was whole: there was nothing to mend")
    else:
        lost = f"{recovery.damaged_chunks} damaged chunks and {recovery.orphans} messages without their topic left out"
        print(f"  {lost}, {recovery.skipped_bytes} bytes unreadable")


def _audit(args: argparse.Namespace) -> int:
    total = sum(read_info(args.recording).message_counts.values())
    with tqdm(total=total, unit=" messages", delay=1.0, disable=None, leave=False) as bar:
        result = audit(args.recording, lambda count: bar.update(count - bar.n))
    if args.json:
        print(json.dumps({**asdict(result), "path": str(result.path)}))
        return 0 if result.ok else 1
    print(f"{'topic':24}{'messages':>10}{'rate [Hz]':>11}{'longest gap [s]':>17}{'lost':>7}")
    for row in result.topics:
        print(f"{row.topic:24}{row.messages:10}{row.rate_hz:11.3f}{row.longest_gap_s:17.3f}{row.lost:7}")
    for check in result.checks:
        print(f"{'ok   ' if check.ok else 'WRONG'} {check.rule}{f': {check.detail}' if check.detail else ''}")
    return 0 if result.ok else 1


def _replay(args: argparse.Namespace) -> None:
    _log_to_stderr()
    profile_toml = read_profile_text(args.profile)
    profile = parse_profile(profile_toml, args.profile)
    faults = load_faults(args.faults) if args.faults is not None else NO_FAULTS
    stopping, part = _stop_on_signals(), {"start_s": args.start, "duration_s": args.duration}
    if args.to == "devices":
        more = {"rate": args.rate, "faults": faults}
        if args.device is not None:
            if args.start or args.duration:
                raise BadInputError("--start and --duration are for recordings; captured bytes are sent whole")
            report = serve_capture(args.recording, profile, args.device, stopping, **more)
        else:
            report = serve_devices(args.recording, profile, stopping, **part, **more)
        print(report.to_json())
    elif args.rate != 1.0 or args.faults is not None or args.device is not None:
        raise BadInputError("--rate, --faults and --device are for --to devices")
    else:
        print(json.dumps(asdict(republish(args.recording, profile, profile_toml, stopping, **part))))


def _compare(args: argparse.Namespace) -> int:
    report = load_report(args.replay) if args.replay is not None else None
    comparison = compare_recordings(args.went_in, args.came_out, report)
    print(comparison.to_json() if args.json else "\n".join(comparison.lines()))
    return 0 if comparison.same else 1


if __name__ == "__main__":
    sys.exit(main())
