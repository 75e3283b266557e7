#!/usr/bin/env python3
"""Stops one thread of a process, as if it hung: tests/vcan/stall.py PID. The other threads keep running.

Traces the process's first thread (which runs the loop). SIGSTOP would instead stop all threads."""

import ctypes
import os
import sys
import time

PTRACE_SEIZE, PTRACE_INTERRUPT = 0x4206, 0x4207

pid = int(sys.argv[1])
libc = ctypes.CDLL(None, use_errno=True)
libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
libc.ptrace.restype = ctypes.c_long
for request in (PTRACE_SEIZE, PTRACE_INTERRUPT):
    if libc.ptrace(request, pid, None, None) != 0:
        sys.exit(f"stall.py: ptrace {request:#x} of {pid}: {os.strerror(ctypes.get_errno())}")
print("stalled", flush=True)
while os.path.exists(f"/proc/{pid}/task/{pid}"):
    with open(f"/proc/{pid}/stat") as stat:
        if stat.read().rsplit(")", 1)[1].split()[0] == "Z":
            break
    time.sleep(0.1)
