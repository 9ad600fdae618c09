"""rtlog-atlas build | info | report | compare | simulate | import: the mapping commands. Only here is anything printed.

What a verb needs is imported in the verb, so that `--help` does not wait for compilers and solvers to load.
"""

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from hw_profiles.command import add_verb, run_verbs
from hw_profiles.errors import BadInputError
from processing.simulation.hazards import hazard_table

HAZARDS = """hazards: each a [[hazards]] of the world's TOML with its kind, the `run` that it strikes (default: all),
and more keys, with these defaults; what has none is drawn by lot, from the seed (a `for_s` without: the whole run):"""

MOST_LINES = 20  # of one kind that `build` prints


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="rtlog-atlas", description="Makes maps of recordings.")
    verbs = parser.add_subparsers(metavar="VERB")

    verb = add_verb(
        verbs, "build", _build, "map recordings", "rtlog-atlas build monday.mcap tuesday.mcap -o level.atlas"
    )
    verb.add_argument("recordings", type=Path, nargs="+", metavar="RUN.mcap")
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="NAME.atlas")
    verb.add_argument("--profile", metavar="P", help="a profile's name or file, in place of the one in the recording")
    verb.add_argument("--method", choices=("landmark", "global"), default="landmark", help="default: %(default)s")
    verb.add_argument("--assembly", choices=("refined", "paper"), default="refined", help="default: %(default)s")
    verb.add_argument(
        "--matcher", choices=("point-to-line", "psm"), default="point-to-line", help="default: %(default)s"
    )
    verb.add_argument("--jobs", type=_jobs, default=1, metavar="N", help="processes; default: %(default)s")
    verb.add_argument("--json", action="store_true", help="the summary as JSON")

    verb = add_verb(verbs, "info", _info, "say what is in an atlas", "rtlog-atlas info level.atlas")
    verb.add_argument("atlas", type=Path, metavar="NAME.atlas")
    verb.add_argument("--json", action="store_true", help="all of atlas.json")

    example = "rtlog-atlas report level.atlas -o level.html"
    verb = add_verb(verbs, "report", _report, "show an atlas and what it rests on, as one page", example)
    verb.add_argument("atlas", type=Path, metavar="NAME.atlas")
    verb.add_argument("-o", "--output", type=Path, metavar="PAGE.html", help="default: NAME.report.html beside it")

    example = "rtlog-atlas compare level.atlas --truth simulated/level"
    verb = add_verb(verbs, "compare", _compare, "measure an atlas against the truth or known relations", example)
    verb.add_argument("atlas", type=Path, metavar="NAME.atlas")
    verb.add_argument("--truth", type=Path, metavar="DIR", help="what `simulate` wrote beside the recordings")
    verb.add_argument("--relations", type=Path, metavar="FILE", help="relative poses of the Freiburg SLAM benchmark")
    verb.add_argument("--json", action="store_true", help="the figures as JSON")

    example = "rtlog-atlas simulate loop -o simulated/loop"
    verb = add_verb(verbs, "simulate", _simulate, "drive through a world and record it, with the truth", example)
    verb.add_argument("world", metavar="WORLD.toml", help="a file, or the name of a shipped world")
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    verb.add_argument("--seed", type=int, help="default: the world's")
    verb.add_argument(
        "--noise-free", action="store_true", help="no hazards, perfect sensors; the same walls and drives"
    )
    verb.add_argument("--run", action="append", metavar="NAME", help="only this run; may be repeated")
    verb.epilog = "\n".join([HAZARDS, *hazard_table(), "", str(verb.epilog)])

    example = "rtlog-atlas import carmen intel.log.gz -o intel.mcap"
    verb = add_verb(verbs, "import", _import, "turn a log of another system into a recording", example)
    verb.add_argument("format", choices=("carmen",))
    verb.add_argument("log", type=Path, metavar="LOG")
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="RUN.mcap")

    signal.signal(signal.SIGTERM, _interrupt)
    sys.unraisablehook = _interrupt_again
    return run_verbs(parser, argv)


def _interrupt(_number: int, _frame: object) -> None:
    """SIGTERM ends a verb as Ctrl-C does: what it had begun to write is removed."""
    raise KeyboardInterrupt


def _interrupt_again(unraisable: "sys.UnraisableHookArgs") -> None:
    """An interrupt that hits a destructor is swallowed there: a compiler that loads has many. So another is sent."""
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        signal.signal(signal.SIGALRM, _interrupt)
        signal.setitimer(signal.ITIMER_REAL, 0.01)
    else:
        sys.__unraisablehook__(unraisable)


def _jobs(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no number of processes")
    return int(text)


def _build(args: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads wait for each other; --jobs does not
    from hw_profiles.profile import load_profile
    from processing.build import Config, build

    began = time.monotonic()
    profile = load_profile(args.profile) if args.profile else None
    config = Config(args.method, args.assembly, args.matcher)
    atlas = build(args.recordings, profile, config, args.output, args.jobs)
    document = atlas.document
    from processing.caveats import caveats, rests_on_little

    told, weak = caveats(document), rests_on_little(document)
    _tell(told, args.output)
    summary = {
        "atlas": str(args.output),
        "runs": len(document["runs"]),
        "nodes": len(document["nodes"]),
        "edges": sum(edge["kind"] == "edge" for edge in document["edges"]),
        "parts": 1 + max(edge["part"] for edge in document["edges"]),
        "seconds": round(time.monotonic() - began, 1),
        **{kind: len(lines) for kind, lines in told.items()},
        "rests_on_little": weak,
    }
    if args.json:
        print(json.dumps(summary))
    else:
        counts = "{runs} runs, {nodes} beacons, {edges} edges, {parts} connected part(s)".format(**summary)
        things = sum(map(len, told.values()))
        known = f", with {things} thing{'s' * (things > 1)} to know above" if things else ""
        little = f"; it rests on little: {', '.join(weak)}" if weak else ""
        print(f"{args.output}: {counts} in {summary['seconds']} s; look at {args.output / 'map.png'}{known}{little}")


def _tell(told: dict[str, list[str]], atlas: Path) -> None:
    for kind, lines in told.items():
        for line in lines[:MOST_LINES]:
            print(f"rtlog-atlas: {line}", file=sys.stderr)
        if more := lines[MOST_LINES:]:
            print(
                f"rtlog-atlas: {len(more)} more {kind.replace('_', ' ')}; rtlog-atlas info {atlas} shows all",
                file=sys.stderr,
            )


def _info(args: argparse.Namespace) -> None:
    from processing.atlas import read_document
    from processing.caveats import caveats, rests_on_little

    document = read_document(args.atlas)
    if args.json:
        print(json.dumps(document))
        return
    for run in document["runs"]:
        print(f"run   {run['id']}: {run['ticks']} ticks, profile {run['profile']}")
    for node in document["nodes"]:
        place = f"({node['x']:.2f}, {node['y']:.2f}) m"
        unread = sum(not each.get("read", True) for each in node["passes"])
        reach = f"read within {node['range']:.1f} m, {len(node['passes'])} passes" + f", {unread} unread" * (unread > 0)
        print(f"node  {node['id']}: {node['epc']} at {place}, {reach}")
    for edge in document["edges"]:
        length = "" if edge["length"] is None else f", {edge['length']:.2f} m"
        print(
            f"{edge['kind']:5} {edge['id']}: {len(edge['paths'])} paths{length}, {edge['links']['strong']} strong links"
        )
    for lines in caveats(document).values():
        for line in lines:
            print(f"note  {line}")
    if weak := rests_on_little(document):
        print(f"note  the map rests on little: {', '.join(weak)}")


def _report(args: argparse.Namespace) -> None:
    from processing.report.page import write_report

    atlas = args.atlas.resolve()  # also where it is called `.`
    output = args.output or atlas.parent / f"{atlas.stem}.report.html"
    write_report(args.atlas, output)
    print(f"{output}: open it in a browser")


def _compare(args: argparse.Namespace) -> None:
    from processing.comparison import compare_relations, compare_truth, table

    if args.truth is None and args.relations is None:
        raise BadInputError("compare with what? --truth DIR or --relations FILE")
    figures: dict[str, object] = {}
    if args.truth is not None:
        figures |= compare_truth(args.atlas, args.truth)
    if args.relations is not None:
        figures |= compare_relations(args.atlas, args.relations)
    print(json.dumps(figures) if args.json else table(figures))


def _simulate(args: argparse.Namespace) -> None:
    from processing.simulation.simulate import simulate

    def tell(run: str, done: int, count: int) -> None:
        print(f"run {done + 1} of {count}: {run}", file=sys.stderr)

    for run in simulate(args.world, args.output, args.seed, not args.noise_free, args.run, tell):
        print(f"{run.path}: {run.length_m:.0f} m in {run.duration_s:.0f} s, {run.ticks} ticks")


def _import(args: argparse.Namespace) -> None:
    from processing.import_carmen import import_carmen

    counts = import_carmen(args.log, args.output)
    print(f"{args.output}: {counts.scans} scans, {counts.odometry} poses of odometry")
    for kind, lines in counts.skipped.items():
        print(f"rtlog-atlas: {lines} lines of {kind} are left out", file=sys.stderr)
    if counts.backward_stamps:
        print(f"rtlog-atlas: {counts.backward_stamps} lines are stamped earlier than the one before", file=sys.stderr)
    if counts.spread_stamps:
        print(f"rtlog-atlas: {counts.spread_stamps} lines had rounded stamps and are spread out", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
