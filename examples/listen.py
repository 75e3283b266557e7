#!/usr/bin/env python3
"""An example ECU in Python that listens to packwatch: it shows the state of charge and maintains the table of alarms.

    examples/listen.py vcan0                     listens on an interface until Ctrl-C
    examples/listen.py frames.log                reads a candump log, such as one of `packwatch replay --frames`
    options: --dbc FILE (default config/packwatch.dbc), --seconds N (stops then)

Needs python-can and cantools. It follows rules 1 to 4 of the contract (docs/src/ecu/contract.md). It leaves out rule 5, which
confirms the table by its checksum. A line is printed for every change.
"""
import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import can
import cantools

DBC = Path(__file__).resolve().parent.parent / "config/packwatch.dbc"
RAISED = {"active", "latched", "suppressed"}
NOT_RAISED = {"none", "unknown", "not watched"}
STATUS_TIMEOUT_S = 0.3
PASSES = 7

Key = tuple[str, str, str]  # rule, severity, cell


class Listener:
    """The receiver. All times are frame times, in seconds."""

    def __init__(self, dbc: Path):
        self.database = cantools.database.load_file(dbc)
        self.alarms: dict[Key, float] = {}  # time of the latest frame of each raised alarm
        self.pass_time_s = 1.0  # time to send each raised alarm once; the digest updates it
        self.status_at: float | None = None
        self.validity = "unavailable"

    def handle(self, frame: can.Message) -> None:
        """Handles a frame. Ignores frames of other senders."""
        try:
            message = self.database.get_message_by_frame_id(frame.arbitration_id)
            signals = {name: text(value) for name, value in message.decode(frame.data).items()}
        except (KeyError, cantools.database.DecodeError):
            return
        if message.name == "PACKWATCH_Status":
            self.handle_status(frame.timestamp, signals)
        elif message.name == "PACKWATCH_Alarm":
            self.handle_alarm(frame.timestamp, signals)
        elif message.name == "PACKWATCH_Digest":
            self.handle_digest(frame.timestamp, signals)
        self.check_time(frame.timestamp)

    def handle_status(self, now: float, signals: dict[str, str]) -> None:
        self.status_at = now
        if signals["Validity"] != self.validity:
            self.validity = signals["Validity"]
            print(f"{now:.1f} status {self.validity}, SOC {percent(signals['Soc'])}", flush=True)

    def handle_alarm(self, now: float, signals: dict[str, str]) -> None:
        rule = signals["Rule"]
        if signals["Test"] == "test":
            return
        cell = "pack" if signals["Cell"] == "not available" else f"cell {int(signals['Cell']) + 1}"
        key = (rule, signals["Severity"], cell)
        if signals["State"] not in RAISED:
            self.remove(now, key, signals["State"])
        elif key in self.alarms:
            self.alarms[key] = now
        else:
            self.alarms[key] = now
            value, threshold = signals[f"Value_{rule}"], signals[f"Threshold_{rule}"]
            print(f"{now:.1f} alarm {' '.join(key)} {signals['State']}: {value}, threshold {threshold}", flush=True)

    def handle_digest(self, now: float, signals: dict[str, str]) -> None:
        """Removes the alarms whose rule the digest reports as not raised. (The frame that announced their end was lost.)"""
        if signals.get("PassTime", "not available") != "not available":
            self.pass_time_s = float(signals["PassTime"])
        for key in list(self.alarms):
            if signals.get(f"Rule_{key[0]}") in NOT_RAISED:
                self.remove(now, key, "digest")

    def check_time(self, now: float) -> None:
        """Discards the status if status frames have stopped, and each alarm whose frames have stopped."""
        if self.status_at is not None and now - self.status_at > STATUS_TIMEOUT_S:
            self.status_at, self.validity = None, "unavailable"
            print(f"{now:.1f} status lost: all values unknown", flush=True)
        for key, latest in list(self.alarms.items()):
            if now - latest > PASSES * self.pass_time_s:
                self.remove(now, key, "not repeated")

    def remove(self, now: float, key: Key, reason: str) -> None:
        if self.alarms.pop(key, None) is not None:
            print(f"{now:.1f} alarm {' '.join(key)} over: {reason}", flush=True)


def text(value: object) -> str:
    """The DBC's name for a value or, if it has none, the number."""
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def percent(value: str) -> str:
    return "unknown" if value == "not available" else f"{float(value):.1f} %"


def frames(source: str, seconds: float | None) -> Iterator[can.Message | None]:
    """Yields the frames of a log or an interface, and `None` after 0.1 s without a frame."""
    if Path(source).is_file():
        yield from can.LogReader(source)
        return
    end = time.monotonic() + seconds if seconds is not None else float("inf")
    with can.Bus(channel=source, interface="socketcan", fd=True) as bus:
        print(f"listening on {source}", flush=True)
        while time.monotonic() < end:
            yield bus.recv(timeout=0.1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Listens to packwatch.")
    parser.add_argument("source", help="CAN interface, or candump log")
    parser.add_argument("--dbc", type=Path, default=DBC)
    parser.add_argument("--seconds", type=float, help="stop after this time")
    options = parser.parse_args()
    listener = Listener(options.dbc)
    try:
        for frame in frames(options.source, options.seconds):
            if frame is None:
                listener.check_time(time.time())
            else:
                listener.handle(frame)
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
