"""Which choice measures best: simulated worlds, several seeds, and a real log; each choice beside what ships.

    .venv/bin/python tests/benchmarks/choices.py > docs/choices.md

Out: a page in Markdown, of which the last section, what was chosen, was written by hand after reading the others.
"""

import argparse
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

from choices_chain import print_chains
from choices_solvers import print_solvers
from choices_worlds import print_relations, print_world

from processing.build import Config, build
from processing.import_carmen import import_carmen
from processing.simulation.simulate import simulate

FIRST_SEED = 101
WORLDS = ("loop", "two_drifts", "missed_tag", "straight", "mine_level")
SHOWN = ("loop", "straight")  # where choices are looked at more closely
CARMEN = Path(__file__).parents[3] / "shared" / "data" / "carmen"

HEADER = """# Choices, by measurement

Which scan matcher, reference scan, assembly and solver make the best map, each beside what ships: point-to-line matches
to a key frame every 0.75 m, the refined assembly, a solver of our own with a robust cost. What is no option of
`rtlog-atlas` is set by `tests/benchmarks/choices_build.py`. Simulated worlds are driven with {seeds} seeds (other
walls, other noise), the real log is that of the Intel Research Lab.

Made by `{command} > docs/choices.md` at commit {commit} on {machine}. What was chosen, and why, stands at the end.
"""

CHAIN = """## Reference: the open-loop chain alone

Which scan a scan is matched to, before any loop is closed. "The scan before" makes every scan a key frame, as in the
paper's plain chain; else a key frame is made after so many metres, or 20° of turn, or where less than 70 % of the
points are common. All seeds of a world together.
"""

SOLVERS = """## Solver: the very same links

The links that the map of each run ends with (first seed, each run by itself, no tags), solved anew from the open-loop
chain. Error: rms over the key frames; of Intel the mean error of the relations. In the second column 1 % of the strong
links are false: they have the motion of another link. The robust cost is Geman–McClure's with one corner for all
who have one; χ² is the plain sum over the true links, smaller where nothing is doubted. gtsam takes a link's error
along its twist, which differs from ours where the error is large. CPU: the least of three; without making gtsam's
graph.
"""

WHOLE = """## Whole maps

Every choice, from the recordings to the atlas. Those that take long or say nothing new on a world are left out there;
so is the largest world, 3 km of smooth tunnels, which `--worlds tunnels` measures. On simulated worlds a row is the
mean over the seeds, the worst seed in brackets. ATE: one rigid move of the whole atlas onto the
truth, rms over all poses of all runs. RPE: relative error over 10 m and 100 m of driving. Precision and recall are
those of the wall cells of the map: a wall drawn twice lowers the precision. NEES: squared error of the edges over
their stated covariance, 3 where that is right ([accuracy.md](accuracy.md)); of few edges it scatters. CPU: of the
build with one job, all that is compiled being there.

### Intel

`--method global`, all 2,984 relations (Kümmerle's metric). There are no tags, so nothing is assembled. A key frame at
every scan is left out: it had not ended after eight minutes of CPU. The other real logs have no relations; their maps
were looked at ([accuracy.md](accuracy.md)).
"""

CHOSEN = """## What was chosen, and why

Written by hand from the tables above.

- **Matcher: point-to-line.** In rough rock `psm` makes as good a map, or one a third further off; in the straight drift
  it is one and a half times as far off, on two_drifts nearly three times, and a build takes two to three times as long.
  On the real log its chain alone is three times as far off, which only the closed loops make good.
- **Reference: a key frame every 0.75 m.** The chain alone drifts the more the nearer the reference is, for each match
  adds its error: most from scan to scan, which is the paper's way, least with key frames 1.5 m to 3 m apart. The
  closed map wants the opposite: links over 2, 4 and 8 m stiffen the chain anyway, and more key frames make more links
  between drives. 0.25 m, or every scan, gains less than a millimetre on the loop and on the real log, and
  loses one in the straight drift, for up to two and a half times the CPU and with covariances that are too sure (NEES
  of 5 to 6 in the mean). 1.5 m loses four millimetres on the loop and two centimetres in the straight drift; 3 m three
  millimetres on the loop and nearly four on the real log.
- **Assembly: refined.** The paper's is nine to sixty times as far off, for it joins drifts at points, by
  lengths and headings. It saves no time.
- **Method: landmark.** Without tags every run is mapped, and here aligned, by itself: one run comes out as well, two
  of them somewhat worse, and nothing joins them.
- **Solver: ours.** On the same links, from the same guess, it comes to the same minimum as gtsam in a third of the
  time or less. On the real log neither finds the lowest cost from the open-loop chain at once; with its corner
  falling ours does, and so a map is solved when a lost stretch is found again. The robust cost hardly changes a map,
  since what matches badly never becomes a link. It is there for what slips through: one false link in a hundred puts
  the plain sum of squares off by ten centimetres to metres, the robust cost by less than a millimetre. One linear
  step is as good where the guess is good, as in a map that grows by stretches of 5 m; from the open-loop chain it is
  five times as far off on the real log.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="default: %(default)s")
    parser.add_argument("--seeds", type=int, default=2, help="default: %(default)s")
    args = parser.parse_args()
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True, cwd=Path(__file__).parent).stdout.strip()
    command = " ".join([".venv/bin/python", *sys.argv])
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    print(HEADER.format(seeds=args.seeds, command=command, commit=commit, machine=machine))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        worlds: dict[str, list[Path]] = {world: [] for world in args.worlds.split(",")}
        for world, truths in worlds.items():
            for seed in range(FIRST_SEED, FIRST_SEED + args.seeds):
                truths.append(folder / f"{world}-{seed}")
                simulate(world, truths[-1], seed)
        first = sorted(next(iter(worlds.values()))[0].glob("*.mcap"))
        build(first, None, Config(), folder / "warm.atlas")  # so that no row pays for what is compiled
        logs, relations = [folder / "intel.mcap"], CARMEN / "intel.relations"
        if relations.exists():
            import_carmen(CARMEN / "intel-merged-raw.log.gz", logs[0])
        print(CHAIN)
        for world in [world for world in worlds if world in SHOWN]:
            print(f"### {world}, the chain alone\n")
            print_chains([recording for truth in worlds[world] for recording in sorted(truth.glob("*.mcap"))])
        if relations.exists():
            print("### Intel, the chain alone\n")
            print_chains(logs, relations)
        print(SOLVERS)
        for world in [world for world in worlds if world in SHOWN]:
            print(f"### {world}, the same links\n")
            print_solvers(sorted(worlds[world][0].glob("*.mcap")))
        if relations.exists():
            print("### Intel, the same links\n")
            print_solvers(logs, relations)
        print(WHOLE)
        if relations.exists():
            print_relations(logs[0], relations, folder)
        else:
            print(f"Not measured, here and above: the log is not in {CARMEN}.\n")
        for world, truths in worlds.items():
            print(f"### {world}\n")
            print_world(world, truths, folder)
    print(CHOSEN, end="")


if __name__ == "__main__":
    main()
