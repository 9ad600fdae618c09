"""Real time for this process, as far as the system grants it; what was not granted is told, and is no error.

Under load SCHED_FIFO is the difference between a tick 0.1 s late and one 0.5 ms late. It needs CAP_SYS_NICE or
LimitRTPRIO, locking the memory needs CAP_IPC_LOCK or LimitMEMLOCK; `systemd/rtlog-server.service` grants all of it.
"""

import ctypes
import gc
import os
import resource
import sys
from pathlib import Path

PRIORITY = 80  # above the kernel's interrupt threads (50), below its watchdogs (99)
SWITCH_INTERVAL_S = 0.0005  # a driver thread gives up the interpreter this soon when the tick thread wants it
CAP_IPC_LOCK = 14  # linux/capability.h
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # sys/mman.h


def become_realtime() -> dict[str, str]:
    """Ask for SCHED_FIFO and locked memory; the answers, by `scheduler` and `memory`, in words.

    Threads started later inherit the scheduling, as they must: whoever holds the interpreter's lock holds up the tick.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        scheduler = f"SCHED_FIFO {PRIORITY}"
    except OSError as error:
        scheduler = f"SCHED_FIFO not granted: {error.strerror}"
    return {"scheduler": scheduler, "memory": _lock_memory()}


def give_up_realtime() -> None:
    """Back to ordinary scheduling. (Locked memory is not inherited by other programs.)"""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def freeze_garbage() -> None:
    """Call when everything is built: from here on nothing is collected but by `gc.collect()` in the slack of a tick."""
    gc.collect()
    gc.freeze()
    gc.disable()


def _lock_memory() -> str:
    if not _may_lock_any_amount():  # else an allocation beyond the limit would fail later, in mid-drive
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        return f"not locked: the limit is {limit // 1024} KiB"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) != 0:  # on fault: a thread's stack costs what it uses
        return f"not locked: {os.strerror(ctypes.get_errno())}"
    return "locked"


def _may_lock_any_amount() -> bool:
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        return True
    status = Path("/proc/self/status").read_text(encoding="ascii")
    effective = next(line for line in status.splitlines() if line.startswith("CapEff:"))
    return bool(int(effective.split()[1], 16) >> CAP_IPC_LOCK & 1)
