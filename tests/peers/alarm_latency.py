"""Measures the time from a frame on vcan0 to the answering frame. The kernel stamps both on one listening socket.

usage: alarm_latency.py alarm FILE COUNT   sends half-cycles to a daemon with the configuration of alarm_latency.test; measures
                                           the time from the frame that ends a half-cycle to the alarm frame
       alarm_latency.py loop FILE COUNT    sends frames 0x123 to a program that answers each with the same data under 0x321
       alarm_latency.py echo               runs such a program; its time is the lower bound
       alarm_latency.py report FOLDER      prints and judges the results; also needs the daemon's files

The times are written to FILE as {"late_ns": [...], ...}. After sending a frame, this program sleeps before it looks for
the answer. With one CPU it would otherwise delay the answering program.
"""
import json
import random
import re
import socket
import struct
import sys
import time
from pathlib import Path

SO_TIMESTAMPNS = 35  # linux/socket.h; not in Python's module
TIMESPEC, FRAME = struct.Struct("@ll"), struct.Struct("=IB3x8s")
CELL, ALARM, ASK, ANSWER = 0x100, 0x6B2, 0x123, 0x321
# Start and length of the alarm frame's bit fields, as in config/packwatch.dbc.
RULE, STATE = (16, 5), (21, 3)
CAPACITY_LOW, ACTIVE, CLEARED = 1, 1, 2
# The first frame after 10 ms (min_duration_s of the configuration) confirms a new mode.
MODE_S = 0.012
# In each half-cycle the current is almost zero except for one pulse. The capacity is the charge of the half-cycle
# divided by the swing (change of SOC) that the configuration states. A weak pulse gives a capacity of 0.25 Ah, and a
# strong pulse 2.1 Ah.
IDLE_A, WEAK_A, STRONG_A, PULSE_S = 0.008, 0.35, 3.0, 0.03
# Ranges of the capacity (charge over swing), Ah. The charge follows from the frames' time stamps. A busy machine
# lengthens pulses and pauses. If the capacity is then near the alarm's thresholds, or impossible for a cell of 2.6 Ah,
# the half-cycle is not judged.
SWING, WEAK_AH, STRONG_AH = 1.2e-5, (0.0, 0.8), (1.4, 4.0)
# The first half-cycles have no complete predecessor.
WARM_UP = 4
PEERS = {
    "daemon": "packwatch, half-cycle to alarm",
    "echo": "program that only echoes",
    "player": "candump | sed | canplayer",
    "cansend": "candump | cansend for each frame",
}
# Time before the program looks for the answer, and maximum wait for the answer, s.
LOOK_S, PATIENCE_S = 0.003, 2.0


def raw(*ids):
    s = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    filters = b"".join(struct.pack("=II", i, 0xDFFFFFFF) for i in ids)
    s.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
    s.bind(("vcan0",))
    return s


def frame(can_id, data):
    return FRAME.pack(can_id, len(data), data)


def cell(current_a):
    voltage_v = 3.75 - 0.045 * current_a
    data = round(voltage_v * 1e5).to_bytes(3, "little") + round(current_a * 1e4).to_bytes(3, "little", signed=True)
    return frame(CELL, data + (2500).to_bytes(2, "little"))


def current_of(data):
    return int.from_bytes(data[3:6], "little", signed=True) * 1e-4


def last_half_cycle(cells, sign):
    """Returns the capacity (charge over swing, Ah) of the half-cycle before the latest change of sign, and the stamp of
    the frame that ended it: the second frame with the new sign. The stamp is None if a busy machine has not delivered
    that frame yet."""
    end = max((n for n, (_, current_a) in enumerate(cells) if current_a * sign < 0), default=-1) + 1
    begin = max((n for n, (_, current_a) in enumerate(cells[:end]) if current_a * sign > 0), default=-1) + 1
    frames = cells[begin : end + 1]
    given = sum((now_a + next_a) / 2 * (next_ns - now_ns) for (now_ns, now_a), (next_ns, next_a) in zip(frames, frames[1:]))
    return abs(given) * 1e-9 / 3600 / SWING, cells[end + 1][0] if end + 1 < len(cells) else None


def bits(data, start, length):
    return int.from_bytes(data, "little") >> start & (1 << length) - 1


class Listener:
    """Receives the frames with these identifiers, with the kernel's stamps."""

    def __init__(self, *ids):
        self.socket = raw(*ids)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.setblocking(False)

    def read(self):
        """Returns all received frames: [(ns, id, data)]."""
        seen = []
        while True:
            try:
                data, control, _, _ = self.socket.recvmsg(72, 128)
            except BlockingIOError:
                return seen
            seconds, nanoseconds = TIMESPEC.unpack(control[0][2][: TIMESPEC.size])
            can_id, length, payload = FRAME.unpack(data)
            seen.append((seconds * 10**9 + nanoseconds, can_id, payload[:length]))

    def stamp_of(self, is_answer):
        """Returns (stamp of the first matching frame or None, all received frames)."""
        seen, deadline = [], time.monotonic() + PATIENCE_S
        time.sleep(LOOK_S)
        while True:
            seen += self.read()
            stamp = next((stamp for stamp, i, data in seen if is_answer(i, data)), None)
            if stamp or time.monotonic() > deadline:
                return stamp, seen
            time.sleep(0.001)


def pause():
    """Waits for a random time, to vary the phase."""
    time.sleep(random.uniform(0.001, 0.011))


def measure_alarm(count):
    """Alternates strong and weak half-cycles. The end of a strong half-cycle clears the alarm. The end of a weak
    half-cycle raises it."""
    listener, sender = Listener(CELL, ALARM), raw()
    late_ns, without, stalled, strong, sign = [], 0, 0, True, 1
    # Number of half-cycles until the next one is judged. After a half-cycle with a wrong charge, the alarm may be
    # unchanged. The next half-cycle then cannot change it back.
    wait, cells = WARM_UP, []
    while len(late_ns) + without < count:
        sender.send(cell(sign * IDLE_A))
        time.sleep(MODE_S)
        sender.send(cell(sign * IDLE_A))
        # If a strong half-cycle begins now, a weak half-cycle has just ended and raises the alarm.
        change = (CAPACITY_LOW, ACTIVE if strong else CLEARED)
        def is_answer(i, data, change=change):
            return i == ALARM and (bits(data, *RULE), bits(data, *STATE)) == change

        answered, seen = (None, listener.read()) if wait else listener.stamp_of(is_answer)
        # Keep enough frames for two half-cycles of six frames each.
        cells = cells[-12:] + [(stamp, current_of(data)) for stamp, i, data in seen if i == CELL]
        low, high = WEAK_AH if strong else STRONG_AH
        given_ah, asked = last_half_cycle(cells, sign)
        if not low <= given_ah <= high:
            wait, stalled = 2, stalled + 1
            assert stalled < count, f"{stalled} half-cycles had a wrong charge: this machine is too busy"
        elif wait:
            wait -= 1
        elif answered is None or asked is None:
            without += 1
            print(f"no answer after {len(late_ns)}: {given_ah:.2f} Ah in {cells}", file=sys.stderr, flush=True)
        else:
            late_ns.append(answered - asked)
        # Between two frames, the daemon interpolates the current linearly. Each edge of a pulse therefore takes two
        # frames.
        pulse_a = STRONG_A if strong else WEAK_A
        for current_a in (IDLE_A, pulse_a):
            sender.send(cell(sign * current_a))
        time.sleep(PULSE_S)
        for current_a in (pulse_a, IDLE_A):
            sender.send(cell(sign * current_a))
        pause()
        strong, sign = not strong, -sign
    return {"late_ns": late_ns, "without": without, "stalled": stalled}


def measure_loop(count):
    listener, sender = Listener(ASK, ANSWER), raw()
    late_ns, without = [], 0
    for number in range(count):
        data = struct.pack("<II", number, 0xA5A5A5A5)
        listener.read()
        sender.send(frame(ASK, data))
        answered, seen = listener.stamp_of(lambda i, d: (i, d) == (ANSWER, data))
        asked = next(stamp for stamp, i, d in seen if (i, d) == (ASK, data))
        if answered is None:
            without += 1
        else:
            late_ns.append(answered - asked)
        pause()
    return {"late_ns": late_ns, "without": without}


def echo():
    s = raw(ASK)
    while True:
        s.send(frame(ANSWER, s.recv(16)[8:]))


def at(late_ns, share):
    """Percentile by nearest rank, ms."""
    return sorted(late_ns)[max(0, -(-len(late_ns) * share // 100) - 1)] / 1e6


def decided_by_frame(folder, late_ns):
    """Keeps only the alarms that a frame triggered. The daemon also checks the clock ten times a second. If a check
    falls between the two frames, the check confirms the mode instead of a frame."""
    stamp = re.compile(r"^\((\d+)\.(\d{9})\)", re.MULTILINE)
    frames = {int(a + b) for a, b in stamp.findall((folder / "watched.journal").read_text())}
    events = map(json.loads, (folder / "watched.events").read_text().splitlines())
    changed_at = [event["time"] for event in events if event["event"] == "alarm"]
    assert len(changed_at) >= len(late_ns), f"{len(changed_at)} alarms in the events, {len(late_ns)} on the bus"
    return [late for late, time in zip(late_ns, changed_at[-len(late_ns) :]) if time in frames]


def report(folder):
    found = {peer: json.loads((folder / f"{peer}.json").read_text()) for peer in PEERS}
    stalled, measured = found["daemon"]["stalled"], found["daemon"]["late_ns"]
    assert not stalled, f"{stalled} half-cycles not judged: run it again on a quieter machine"
    found["daemon"]["late_ns"] = decided_by_frame(folder, measured)
    print(f"{'ms':34} {'p50':>8} {'p99':>8} {'max':>8}   of")
    for peer, row in found.items():
        late_ns = row["late_ns"]
        values = " ".join(f"{at(late_ns, share):8.3f}" for share in (50, 99, 100))
        print(f"{PEERS[peer]:34} {values}   {len(late_ns)}")
    daemon = found["daemon"]
    print(f"decided by the clock between two frames, not counted: {len(measured) - len(daemon['late_ns'])}")
    lost = {peer: row["without"] for peer, row in found.items() if row["without"]}
    assert not lost, f"frames without an answer: {lost}"
    assert len(daemon["late_ns"]) >= 1000 and min(daemon["late_ns"]) > 0, "too few results, or an answer before its frame"
    slowest, usual = at(daemon["late_ns"], 99), at(found["cansend"]["late_ns"], 50)
    assert slowest < usual, f"p99 of the daemon, {slowest} ms, is not below the median of cansend per frame, {usual} ms"


def main(words):
    match words:
        case ["alarm", name, count]:
            Path(name).write_text(json.dumps(measure_alarm(int(count))))
        case ["loop", name, count]:
            Path(name).write_text(json.dumps(measure_loop(int(count))))
        case ["echo"]:
            echo()
        case ["report", folder]:
            report(Path(folder))
        case _:
            sys.exit(__doc__)


main(sys.argv[1:])
