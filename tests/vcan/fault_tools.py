#!/usr/bin/env python3
"""Shared tools of the fault tests: a robust player, floods, and comparisons of announced, stored and true values.

    fault_tools.py play LOG INTERFACE [--from SAMPLE]      plays a candump log in real time. While the interface is down or missing, frames
                                                           are dropped and time passes, as for a real pack. SIGTERM parks the pack
    fault_tools.py flood INTERFACE --seconds S [--rate N] [--ids N]   sends frames with unconfigured identifiers
    fault_tools.py clients SOCKET [--count N] [--seconds S]  opens status clients that never read; fails unless clients of another process are answered
    fault_tools.py learned STATE [EVENTS...] [--exactly]   prints the store's capacities, half-cycles and alarms; fails if a reported event is missing
    fault_tools.py alarm DUMP RULE                         prints the state of the rule's last alarm frame
    fault_tools.py same BEFORE AFTER                       fails unless two snapshots have the same learned values
    fault_tools.py apart DUMP ID OTHER POINTS INTERFACE    fails if the status frames of two daemons differ by more than POINTS of SOC
    fault_tools.py covers FOLDER DUMP [--after SAMPLE]     compares the estimates in DUMP with the true SOC, which fast_pack wrote to FOLDER
"""

import argparse
import collections
import errno
import json
import multiprocessing
import random
import signal
import socket
import sqlite3
import struct
import sys
import time
from pathlib import Path

AWAY = {errno.ENETDOWN, errno.ENXIO, errno.ENODEV, errno.ENOBUFS}


def frames(lines, interface="vcan0"):
    """Yields identifier and payload of candump's lines for an interface."""
    for line in lines:
        words = line.split()
        if len(words) == 3 and words[0].startswith("(") and words[1] == interface and words[2].count("#") == 1:
            name, data = words[2].split("#")
            if not data.startswith("R"):
                yield int(name, 16), bytes.fromhex(data)


# ---- packwatch's frames, as its built-in DBC lays them out -----------------------------------------------------------------------

STATUS, HEALTH, ALARM, SAMPLE, PLAYED = 0x6B0, 0x6B1, 0x6B2, 0x7F0, 0x7F1
VALID, ACTIVE, CLEARED = 1, 1, 2
MOVING = (1, 3)  # charge, discharge
# Properties of fast_pack.
PERIOD_S, MAX_RATE_PER_S = 0.01, 0.32
MEMORY = 300  # samples
LOST = 0.75  # minimum share of estimates within two standard deviations; a smaller share means that a fault made the estimates wrong (calibration: tests/integration/restart.rs)
TOO_LATE_S, STEP_S = 0.1, 600.0


def bits(data: bytes, start: int, length: int) -> int:
    return int.from_bytes(data, "little") >> start & ((1 << length) - 1)


class Status:
    """A status frame."""

    def __init__(self, data: bytes):
        self.soc, self.soc_std = bits(data, 16, 12) * 0.00025, bits(data, 28, 8) * 0.001
        self.mode, self.valid = bits(data, 36, 3), bits(data, 39, 3) == VALID and bits(data, 28, 8) != 255
        self.cell = bits(data, 51, 11)


class Alarm:
    """An alarm frame."""

    def __init__(self, data: bytes):
        self.rule, self.severity, self.cell = bits(data, 16, 5), bits(data, 24, 2), bits(data, 27, 11)
        self.state = bits(data, 21, 3)
        self.key = (self.rule, self.severity, self.cell)


class Truth:
    """The true SOC of each cell at each sample, from fast_pack."""

    def __init__(self, folder: Path):
        self.samples: list[list[float]] = []
        with open(folder / "truth.csv") as file:
            column = next(file).rstrip().split(",").index("soc")
            for row in file:
                words = row.split(",")
                if words[1] == "0":
                    self.samples.append([])
                self.samples[-1].append(float(words[column]))

    def errors(self, lines, after: int = -1) -> list[tuple[float, float]]:
        """Error and stated standard deviation of each estimate on the bus after sample `after`. On a busy machine, the
        player is late, and the SOC changes in this delay. Each error is reduced by the largest possible change."""
        sample, found = -1, []
        self.latest_s = 0.0
        late_s = collections.deque(maxlen=MEMORY)  # delay of each sample in the last seconds
        for line in lines:
            for name, data in frames([line]):
                if name == SAMPLE:
                    sample = int.from_bytes(data, "big")
                    late_s.append(float(line[1 : line.index(")")]) - sample * PERIOD_S)
                    if len(late_s) > 1 and abs(late_s[-1] - late_s[-2]) > STEP_S:
                        late_s.clear()  # the clock was stepped
                    else:
                        self.latest_s = max(self.latest_s, late_s[-1] - min(late_s))
                elif name == PLAYED:
                    late_s.clear()
                elif name == STATUS and after < sample < len(self.samples) and late_s:
                    status = Status(data)
                    if status.valid and status.cell < len(self.samples[sample]):
                        error = abs(status.soc - self.samples[sample][status.cell])
                        excused = min(1.0, MAX_RATE_PER_S * (max(late_s) - min(late_s)))
                        found.append((max(0.0, error - excused), status.soc_std))
        return found


def within(errors: list[tuple[float, float]]) -> float:
    """Fraction of errors that do not exceed two standard deviations plus one point of SOC."""
    return sum(error <= 2 * std + 0.01 for error, std in errors) / max(1, len(errors))


def covers(args) -> None:
    truth = Truth(args.folder)
    errors = truth.errors(open(args.dump), args.after)
    worst = max((error for error, _ in errors), default=0.0)
    print(f"{len(errors)} estimates, at most {100 * worst:.1f} points off, {100 * within(errors):.0f} % within two deviations")
    if within(errors) <= LOST and truth.latest_s < TOO_LATE_S:
        sys.exit("the estimates do not cover the truth")
    if truth.latest_s >= TOO_LATE_S:
        print(f"    not judged: frames came {truth.latest_s:.2f} s late, minutes of the pack's life")


def last_alarm(args) -> None:
    """Prints the state in the last alarm frame of a rule, or - if there is no frame."""
    found = [alarm.state for name, data in frames(open(args.dump)) if name == ALARM and (alarm := Alarm(data)).rule == args.rule]
    print(found[-1] if found else "-")


# ---- the store -----------------------------------------------------------------------------------------------------------------------

RULES = (
    "capacity_low usable_capacity_low recharge_period_low input_missing input_implausible estimate_untrusted resistance_high soc_low "
    "temperature_high cell_imbalance remaining_life_low bms_disagrees store_failed bus_fault cell_leak "
    "connection_resistance channel_faulty thermal_event"
).split()
SEVERITIES = {"info": 1, "warning": 2, "severe": 3}
NOT_STORED = ("suppressed", "resumed")  # changes that get no row in the store


class Store:
    """The rows of a state folder's database. The daemon may still be running."""

    def __init__(self, folder: Path):
        database = sqlite3.connect(f"file:{folder / 'packwatch.db'}?mode=ro", uri=True, timeout=10)
        self.integrity = database.execute("PRAGMA integrity_check").fetchone()[0]
        self.half_cycles = database.execute("SELECT moment, cell, mode, charge_ah FROM half_cycle ORDER BY moment, cell").fetchall()
        self.capacities = database.execute("SELECT seq, cell, capacity_ah FROM capacity ORDER BY seq").fetchall()
        rows = database.execute("SELECT seq, rule, severity, cell, change FROM alarm ORDER BY seq").fetchall()
        self.alarms = [(seq, RULES.index(rule) + 1, SEVERITIES[severity], 2047 if cell is None else cell, change)
                       for seq, rule, severity, cell, change in rows]
        database.close()

    def counts(self) -> tuple[int, int, int]:
        return len(self.capacities), len(self.half_cycles), len(self.alarms)

    def begins_with(self, earlier: "Store") -> bool:
        """Whether all rows of the earlier state still exist unchanged."""
        pairs = [(self.half_cycles, earlier.half_cycles), (self.capacities, earlier.capacities), (self.alarms, earlier.alarms)]
        return all(now[: len(before)] == before for now, before in pairs)


def reported_by(files: list[Path]) -> tuple[int, int, int]:
    """Number of learned capacities, half-cycles and alarm changes in files of events."""
    counts = [0, 0, 0]
    for line in (line for file in files for line in open(file)):
        try:
            event = json.loads(line)
        except ValueError:
            continue  # the last line of a killed daemon
        counts[0] += event["event"] == "capacity" and event["measured_ah"] is not None
        counts[1] += event["event"] == "half_cycle"
        counts[2] += event["event"] == "alarm" and event["change"] not in NOT_STORED
    return tuple(counts)


def learned(args) -> None:
    """Reads the events first and the store second. If the daemon stores a value between these two steps, the store has
    an extra row, which is allowed."""
    reported, stored = reported_by(args.events), Store(args.state).counts()
    print(" ".join(map(str, stored)))
    if any(of_store < of_events for of_store, of_events in zip(stored, reported)):
        sys.exit(f"reported {reported}, stored only {stored} (capacities, half-cycles, alarms)")
    if args.exactly and reported != stored:
        sys.exit(f"reported {reported}, stored {stored} (capacities, half-cycles, alarms)")


# ---- snapshots -----------------------------------------------------------------------------------------------------------------------


OF_NOW = ("input_missing", "input_implausible", "bus_fault", "store_failed")
RAISED = ("active", "latched", "suppressed")  # suppressed: the alarm's input is missing


def learned_of(snapshot: dict) -> tuple[list, list]:
    """Capacities and raised alarms. A restart must restore them."""
    capacities = [round(cell["mean"], 9) for cell in snapshot["learning"]["learner"]["capacity"]]
    alarms = [[a["rule"], a["severity"], a["cell"]] for a in snapshot["alarming"]["alarms"]["alarms"]
              if a["machine"]["state"] in RAISED and a["rule"] not in OF_NOW]
    return capacities, sorted(alarms, key=str)


def comes_back(before: dict, after: dict) -> bool:
    """Whether the later state contains all learned values and raised alarms. It may contain further alarms, because a
    daemon without input raises alarms."""
    (capacities, alarms), (later_capacities, later_alarms) = learned_of(before), learned_of(after)
    near = all(abs(now - then) < 1e-6 for then, now in zip(capacities, later_capacities, strict=True))
    return near and all(alarm in later_alarms for alarm in alarms)


def same(args) -> None:
    before, after = (json.loads(path.read_text()) for path in (args.before, args.after))
    if not comes_back(before, after):
        sys.exit(f"other learned values:\n{learned_of(before)}\n{learned_of(after)}")
    packs = [state["learning"]["pack"] for state in (before, after)]
    socs = [f"{100 * pack['soc']:.1f} +/- {100 * pack['soc_std']:.1f} %" if pack else "unknown" for pack in packs]
    print(f"{len(learned_of(after)[0])} capacities and {len(learned_of(after)[1])} alarms as before, SOC {socs[0]} before, {socs[1]} after")


def apart(args) -> None:
    """Compares the SOC in the status frames of two daemons on one bus."""
    latest, worst, pairs, unsure = {}, 0.0, 0, 0
    names = [int(args.whole, 16), int(args.other, 16)]
    for name, data in frames(open(args.dump), args.interface):
        if name not in names:
            continue
        status = latest[name] = Status(data)
        if name == names[1] and names[0] in latest and latest[names[0]].valid:
            if status.valid:
                worst, pairs = max(worst, abs(status.soc - latest[names[0]].soc)), pairs + 1
            else:
                unsure += 1
    print(f"{pairs} estimates at most {100 * worst:.3f} points from those of the daemon that was not killed, {unsure} without a value")
    sys.exit(0 if pairs > 100 and 100 * worst <= args.points else "too far apart")


# ---- sending ---------------------------------------------------------------------------------------------------------


class Bus:
    """A raw socket on an interface that may disappear and return."""

    def __init__(self, interface: str):
        self.interface, self.socket, self.dropped = interface, None, 0

    def send(self, name: int, data: bytes) -> None:
        packet = struct.pack("=IB3x8s", name | (socket.CAN_EFF_FLAG if name > 0x7FF else 0), len(data), data.ljust(8, b"\0"))
        try:
            if self.socket is None:
                self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
                self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
                self.socket.bind((self.interface,))
            self.socket.send(packet)
        except OSError as error:
            if error.errno not in AWAY:
                raise
            self.dropped += 1
            if error.errno in (errno.ENXIO, errno.ENODEV) and self.socket:
                self.socket.close()
                self.socket = None


def park(bus: Bus, rests: list) -> None:
    """Sends half a second without current, so that running half-cycles end and are learned."""
    for _ in range(50 if rests else 0):
        bus.send(0x100, bytes(4) + rests[-1][4:])
        time.sleep(0.01)
    sys.exit(0)


def play(args) -> None:
    bus = Bus(args.interface)
    first = started = None
    wanted = args.start == 0
    currents: list = []
    signal.signal(signal.SIGTERM, lambda *_: park(bus, currents))
    bus.send(PLAYED, b"")
    with open(args.log) as log:
        for line in log:
            stamp, _, frame = line.split()
            if not wanted:
                wanted = frame == f"7F0#{args.start:08X}"
                continue
            at = float(stamp[1:-1])
            if first is None:
                first, started = at, time.monotonic()
            wait_s = (at - first) - (time.monotonic() - started)
            if wait_s > 0.001:
                time.sleep(wait_s)
            name, data = int(frame[:3], 16), bytes.fromhex(frame[4:])
            if name == 0x100:
                currents[:] = [data]
            bus.send(name, data)
    print(f"played to its end, {bus.dropped} frames dropped while the interface was away")


def flood(args) -> None:
    """Sends a burst of frames every 10 ms. The size of a burst follows from the rate."""
    bus, rng = Bus(args.interface), random.Random(1)
    ids = [0x200 + n for n in range(min(args.ids, 0x480))] + [0x18000000 + 977 * n for n in range(args.ids - 0x480)]
    data = [rng.randbytes(8) for _ in range(64)]
    started, sent = time.monotonic(), 0
    while (past := time.monotonic() - started) < args.seconds:
        while sent < past * args.rate:
            bus.send(ids[sent % len(ids)], data[sent % 64])
            sent += 1
        time.sleep(0.01)
    print(f"{sent} frames of {len(ids)} identifiers in {past:.1f} s, {bus.dropped} not accepted")


def clients(args) -> None:
    """Opens many idle clients that never read, in one process. Clients of another process must still be answered."""
    def connected(path):
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.settimeout(10)
        client.connect(path)
        return client

    def hold_idle_clients(opened) -> None:
        stream = args.socket.replace("status.sock", "status-stream.sock")
        idle = [connected(stream if number % 4 == 0 else args.socket) for number in range(args.count)]
        opened.send(len(idle))
        signal.pause()

    received, opened = multiprocessing.Pipe(duplex=False)
    holder = multiprocessing.Process(target=hold_idle_clients, args=(opened,), daemon=True)
    holder.start()
    opened.close()
    idle = received.recv()
    attempts, answered = 0, 0
    ends = time.monotonic() + args.seconds
    while time.monotonic() < ends:
        attempts += 1
        with connected(args.socket) as client:
            answered += bool(client.recv(65536))
        time.sleep(0.2)
    holder.kill()
    print(f"{idle} clients that do not read, {answered} of {attempts} others answered")
    if answered < attempts:
        sys.exit("a client of another process was not answered while idle clients were connected")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("play")
    command.add_argument("log")
    command.add_argument("interface")
    command.add_argument("--from", dest="start", type=int, default=0)
    command.set_defaults(run=play)
    command = commands.add_parser("flood")
    command.add_argument("interface")
    command.add_argument("--seconds", type=float, required=True)
    command.add_argument("--rate", type=float, default=8000)
    command.add_argument("--ids", type=int, default=1)
    command.set_defaults(run=flood)
    command = commands.add_parser("clients")
    command.add_argument("socket")
    command.add_argument("--count", type=int, default=200)
    command.add_argument("--seconds", type=float, default=5.0)
    command.set_defaults(run=clients)
    command = commands.add_parser("covers")
    command.add_argument("folder", type=Path)
    command.add_argument("dump", type=Path)
    command.add_argument("--after", type=int, default=-1)
    command.set_defaults(run=covers)
    command = commands.add_parser("alarm")
    command.add_argument("dump", type=Path)
    command.add_argument("rule", type=int)
    command.set_defaults(run=last_alarm)
    command = commands.add_parser("same")
    command.add_argument("before", type=Path)
    command.add_argument("after", type=Path)
    command.set_defaults(run=same)
    command = commands.add_parser("apart")
    command.add_argument("dump", type=Path)
    command.add_argument("whole")
    command.add_argument("other")
    command.add_argument("points", type=float)
    command.add_argument("interface")
    command.set_defaults(run=apart)
    command = commands.add_parser("learned")
    command.add_argument("state", type=Path)
    command.add_argument("events", type=Path, nargs="*")
    command.add_argument("--exactly", action="store_true")
    command.set_defaults(run=learned)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
