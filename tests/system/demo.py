"""`make demo`: one drive through a mine, from the wire to the atlas, by the commands that a user has.

    simulate ─ recording ─ replay --to devices ═ wire ═ rtlog-server ═ zenoh ═ rtlog-client record ─ live recording ┐
        └───── recording of the rest of the drive ──────────────────────────────────────── rtlog-atlas build ── atlas

The first run is played in real time to the emulators of a laser, two encoders and a tag reader; the server samples
them as it would the devices. Exit status 0: no tick was lost and the map is as near to the truth as it should be.
"""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
OUT = ROOT / "demo_output"
BIN = Path(sys.executable).parent
FIRST, REST = "demo-first", "demo-rest"
MOST_ATE_M = 0.10
LEAST_LIVE_S = 60.0


def main() -> int:
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir()
    began = time.monotonic()
    say("simulate a mine level: drifts, tags, two runs, sensors that err")
    simulated = OUT / "simulated"
    run("rtlog-atlas", "simulate", "demo", "-o", simulated)
    say("drive the first run in real time: emulated devices, server, recorder")
    replayed, status, recorded = drive(simulated / f"{FIRST}.mcap")
    say("build the atlas of the live recording and the simulated rest")
    live = Path(recorded["path"])
    run("rtlog-atlas", "build", live, simulated / f"{REST}.mcap", "-o", OUT / "demo.atlas")
    say("compare with the truth")
    truth = lay_out_truth(simulated, live.stem, replayed["offset_ns"])
    figures = json.loads(run("rtlog-atlas", "compare", OUT / "demo.atlas", "--truth", truth, "--json"))
    seconds = time.monotonic() - began
    return summarise(status, recorded, figures, seconds)


def say(stage: str) -> None:
    print(f"demo: {stage}", flush=True)


def run(program: str, *arguments: object) -> str:
    """Run one of our commands to its end; its answer. Ends the demo with its message if it fails."""
    command = [str(BIN / program), *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"demo: {program} {arguments[0]} failed with status {done.returncode}")
    return done.stdout


def start(program: str, *arguments: object) -> subprocess.Popen[str]:
    command = [str(BIN / program), *map(str, arguments)]
    log = (OUT / f"{program}-{arguments[0]}.log").open("w")
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=log, text=True)


def drive(recording: Path) -> tuple[dict, dict, dict]:
    """Replay, serve, record; what the replay, the server and the recorder say of it."""
    recorder = start("rtlog-client", "record", "-o", OUT, "--name", "demo-live", "--json")
    server = start("rtlog-server", "run", "--profile", "simulated")
    replay = start("rtlog-client", "replay", recording, "--to", "devices", "--profile", "simulated")
    try:
        played = replay.communicate(timeout=180)[0]
        status = server_status()
        recorder.send_signal(signal.SIGINT)
        recorded = recorder.communicate(timeout=30)[0]
    finally:
        for process in (replay, recorder, server):
            process.terminate()
            process.wait(timeout=30)
    if replay.returncode or recorder.returncode or server.returncode:
        sys.exit(f"demo: the live drive failed; see the logs in {OUT}")
    return json.loads(played), status, json.loads(recorded)[0]


def server_status() -> dict:
    """What the server answers to `@status`."""
    import zenoh

    config = zenoh.Config()
    for key, value in (("mode", '"client"'), ("connect/endpoints", '["tcp/127.0.0.1:7447"]')):
        config.insert_json5(key, value)
    with zenoh.open(config) as session:
        reply = next(iter(session.get("rtlog/simulated/@status")))
        return json.loads(reply.ok.payload.to_bytes())


def lay_out_truth(simulated: Path, live_id: str, offset_ns: int) -> Path:
    """The truth as `compare` wants it: that of the replayed run moved to the time at which it was replayed."""
    truth = OUT / "truth"
    truth.mkdir()
    for name in ("walls.csv", "tags.csv", f"{REST}.tum"):
        shutil.copy(simulated / name, truth / name)
    with (simulated / f"{FIRST}.tum").open() as source, (truth / f"{live_id}.tum").open("w") as target:
        for line in source:
            stamp, rest = line.split(" ", 1)
            seconds, fraction = stamp.split(".")
            ns = int(seconds) * 10**9 + int(fraction.ljust(9, "0")) + offset_ns
            target.write(f"{ns // 10**9}.{ns % 10**9:09d} {rest}")
    return truth


def summarise(status: dict, recorded: dict, figures: dict, seconds: float) -> int:
    """Print what came out, and judge it."""
    ticks, lost = status["ticks"], sum(recorded["lost"].values())
    truth = figures["truth"]
    live_s = recorded["ticks"] * 0.1
    ate_m, walls = truth["ate"]["rmse_m"], truth["walls"]
    checks = [
        (ticks["dropped"] == 0 and lost == 0, f"nothing lost: {ticks['dropped']} dropped, {lost} missing"),
        (ticks["sampled"] - recorded["ticks"] <= 40, "recorded from the start"),  # it waits for the server to be up
        (live_s >= LEAST_LIVE_S, f"{live_s:.0f} s driven live"),
        (
            ate_m <= MOST_ATE_M,
            f"error of the trajectory {ate_m:.3f} m, rms of the whole atlas (at most {MOST_ATE_M} m)",
        ),
        (truth["parts"] == 1, f"{truth['parts']} connected part"),
    ]
    late = ticks["lateness_s"]
    print(f"""
ticks sampled     {ticks["sampled"]:6}   late by {1e3 * late["p50"]:.2f} ms (median), {1e3 * late["max"]:.2f} ms (worst)
ticks published   {status["published"]["/rtlog/tick"]:6}
ticks recorded    {recorded["ticks"]:6}   from when the recorder had found the server
samples lost      {lost:6}
error vs truth    {ate_m:6.3f} m trajectory; walls: precision {walls["precision"]:.3f}, recall {walls["recall"]:.3f}
time              {seconds:6.0f} s
""")
    for held, what in checks:
        print(f"{'ok    ' if held else 'FAILED'} {what}")
    print(f"""
look at           {OUT / "demo.atlas" / "map.png"}
the recording     {recorded["path"]}   (rtlog-client audit; Foxglove, rosbags and PlotJuggler read it too)
the atlas         {OUT / "demo.atlas"}   (rtlog-atlas info)""")
    return 0 if all(held for held, _ in checks) else 1


if __name__ == "__main__":
    sys.exit(main())
