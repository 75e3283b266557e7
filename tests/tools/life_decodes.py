"""Decodes every frame of a replayed life with cantools and compares it with the replay's reports.

usage: life_decodes.py FILE.dbc FRAMES.log ESTIMATES.csv EVENTS.jsonl RATED_AH

FRAMES, ESTIMATES and EVENTS come from `packwatch replay`, FILE.dbc from `packwatch dbc` with the same configuration.
The expected values are computed independently:

- status frame: from the mode, signal, trust, gap and alarm events, and from the estimates. `Life.combined` computes the
  pack's values from the estimates of the cells
- health frame: from the capacity, loss mode, remaining life and recharge events, and from the estimates
- alarm and digest frames: from the alarm events

Every value must agree within one bit, and unknown values must be sent as unknown. The last line is a JSON document with
the comparison. The exit status is 0 only if all values agree.
"""
import csv
import json
import re
import sys
from collections import Counter, defaultdict

import cantools

MODES = {"unknown": 0, "charge": 1, "rest": 2, "discharge": 3}
SEVERITIES = {"info": 1, "warning": 2, "severe": 3}
STATES = {"inactive": 0, "active": 1, "clearing": 1, "cleared": 2, "pending": 3, "latched": 4, "suppressed": 5, "unknown": 6}
MAX_PRINTED = 20
WAIT_NS = 2 * 10**9  # longest time that the first frame after an event waits for the frame budget
LOSS_SIGNALS = ("Lli", "LliStd", "LamNe", "LamNeStd", "LamPe", "LamPeStd")


class Reader:
    """Decodes frames with cantools."""

    def __init__(self, path):
        self.database = cantools.database.load_file(path, strict=True)
        self.unavailable, self.signals = {}, {}
        for message in self.database.messages:
            for signal in message.signals:
                key = message.name, signal.name
                self.signals[key] = signal
                words = signal.choices or {}
                self.unavailable[key] = {code for code, word in words.items() if str(word) == "not available"}

    def decode(self, frame_id, data):
        """Returns (name of the message, {signal: value}). The value is None if it is not available."""
        message = self.database.get_message_by_frame_id(frame_id)
        raw = message.decode(data, decode_choices=False, scaling=False)
        name = message.name.removeprefix("PACKWATCH_")
        values = {}
        for signal, code in raw.items():
            key = message.name, signal
            known = code not in self.unavailable[key]
            values[signal] = self.signals[key].raw_to_scaled(code, decode_choices=False) if known else None
        return name, values

    def bit(self, message, signal):
        return self.signals["PACKWATCH_" + message, signal].scale

    def clip(self, message, signal, value):
        """Returns the value limited to the signal's range."""
        found = self.signals["PACKWATCH_" + message, signal]
        return min(max(value, float(found.minimum)), float(found.maximum))


class Life:
    """The state of the pack according to the replay's reports up to a given time."""

    def __init__(self, cells, rated_ah):
        self.cells, self.rated_ah = cells, rated_ah
        self.estimate = {}  # cell: row
        self.capacity = {}  # cell: (Ah, standard deviation)
        self.usable = {}
        self.learned = set()
        self.in_round = set()
        self.pack = None
        self.mode = "unknown"
        self.bad, self.untrusted = set(), set()
        self.changed = {}  # last event of every alarm, by (rule, cell, severity)
        self.alarms = {}  # last event of every raised alarm, by (rule, cell, severity)
        self.recharge = None  # the last reported period
        self.normalised = None
        self.life = dict.fromkeys(("RemainingCycles", "RemainingCyclesLow", "RemainingDays"))
        self.losses = {}  # by cell: signals of its loss modes
        self.moved = set()  # cells that the last mode change has changed and that have had no new row since

    def take_estimate(self, row):
        cell = int(row["cell"])
        self.moved.discard(cell)
        self.estimate[cell] = row
        self.capacity[cell] = float(row["capacity_ah"]), float(row["capacity_std_ah"])
        second = cell in self.in_round
        self.in_round.add(cell)
        if second or len(self.in_round) == self.cells:
            self.in_round.clear()
            self.pack = self.combined()

    def combined(self):
        shares = [(float(row["soc"]), float(row["soc_std"]), self.capacity[cell][0], cell)
                  for cell, row in sorted(self.estimate.items())]
        weakest = min(shares, key=lambda share: share[0] * share[2])
        dischargeable = weakest[0] * weakest[2]
        capacity = dischargeable + min((1.0 - soc) * ah for soc, _, ah, _ in shares)
        return (dischargeable / capacity, weakest[1], weakest[3]) if capacity > 0 else None

    def take_event(self, event):
        kind = event["event"]
        if kind == "mode":
            self.mode = event["to"]
            self.moved = set(self.estimate)
        elif kind == "capacity":
            cell = event["cell"]
            self.capacity[cell] = event["capacity_ah"], event["capacity_std_ah"]
            if event["usable_capacity_ah"] is not None:
                self.usable[cell] = event["usable_capacity_ah"], event["usable_capacity_std_ah"]
            if event["measured_ah"] is not None:
                self.learned.add(cell)
        elif kind == "loss_modes":
            self.losses[event["cell"]] = {
                signal + end: 100 * event[key + end_key]
                for signal, key in (("Lli", "lli"), ("LamNe", "lam_ne"), ("LamPe", "lam_pe"))
                for end, end_key in (("", ""), ("Std", "_std"))
            }
        elif kind == "remaining_life":
            self.life = {"RemainingCycles": event["cycles"], "RemainingCyclesLow": event["cycles_low"],
                         "RemainingDays": event["days"]}
        elif kind == "recharge_period":
            self.recharge = event["seconds"] if event["seconds"] is not None else self.recharge
            self.normalised = event["normalised_s"] if event["normalised_s"] is not None else self.normalised
        elif kind in ("signal_bad", "signal_good"):
            (self.bad.add if kind == "signal_bad" else self.bad.discard)(json.dumps(event["channel"]))
        elif kind == "trust":
            (self.untrusted.discard if event["trusted"] else self.untrusted.add)(event["cell"])
        elif kind == "gap":
            self.pack, self.mode = None, "unknown"
        elif kind == "alarm":
            key = event["rule"], event["cell"], event["severity"]
            self.changed[key] = event
            if event["active"]:
                self.alarms[key] = event
            else:
                self.alarms.pop(key, None)

    def validity(self):
        if self.pack is None:
            return 0
        return 3 if self.untrusted else 2 if self.bad else 1

    def status(self):
        soc, std, cell = self.pack or (None, None, None)
        highest = max((SEVERITIES[severity] for _, _, severity in self.alarms), default=0)
        return {
            "Soc": scaled(soc, 100), "SocStd": scaled(std, 100), "LimitingCell": cell, "Mode": MODES[self.mode],
            "Validity": self.validity(), "ActiveAlarms": len(self.alarms),
            "HighestSeverity": highest if highest or self.pack else None,
        }

    def health(self):
        if len(self.learned) < self.cells:
            known = dict.fromkeys(("Capacity", "CapacityStd", "Soh", "UsableCapacity", "UsableCapacityStd",
                                   "ResistanceRatio", "NormalizedRechargePeriod"))
        else:
            ah, std = min(self.capacity.values())
            usable, usable_std = min(self.usable.values(), default=(None, None))
            ratio = max(float(row["resistance_ratio"]) for row in self.estimate.values())
            known = {"Capacity": ah, "CapacityStd": std, "Soh": 100 * ah / self.rated_ah, "UsableCapacity": usable,
                     "UsableCapacityStd": usable_std, "ResistanceRatio": 100 * ratio,
                     "NormalizedRechargePeriod": self.normalised}
        weakest = min(self.capacity, key=self.capacity.get) if len(self.learned) >= self.cells else None
        known |= self.losses.get(weakest, dict.fromkeys(LOSS_SIGNALS))
        known |= self.life if len(self.learned) >= self.cells else dict.fromkeys(self.life)
        return known | {"RechargePeriod": self.recharge}


def scaled(value, factor):
    return None if value is None else factor * value


def snake(word):
    return re.sub(r"(?<!^)(?=[A-Z])", "_", word).lower()


def nanos(text):
    seconds, fraction = text.split(".")
    return int(seconds) * 10**9 + int(fraction.ljust(9, "0"))


def frames(path):
    """Yields (time, identifier, data) of each line, classic or FD."""
    with open(path) as lines:
        for line in lines:
            stamp, _, frame = line.split()
            number, data = frame.split("#", 1)
            # CAN FD has a second # and a digit of flags.
            yield nanos(stamp[1:-1]), int(number, 16), bytes.fromhex(data[2:] if data.startswith("#") else data)


class Comparison:
    def __init__(self, reader, rules):
        self.reader, self.rules = reader, rules
        self.frames, self.values = Counter(), Counter()
        self.faults, self.printed = 0, []
        self.counters = {}
        self.unreported = 0  # recharge periods without an event in the log
        # Resistances that cannot be compared: at a mode change the monitor learns the current's offset, which changes a
        # resistance before the next rows report it.
        self.restated = 0

    def fault(self, time, message, what):
        self.faults += 1
        if len(self.printed) < MAX_PRINTED:
            self.printed.append(f"{time / 1e9:.3f} {message}: {what}")

    def value(self, time, message, signal, found, wanted):
        self.values[f"{message}.{signal}"] += 1
        if (found is None) != (wanted is None):
            self.fault(time, message, f"{signal} is {found}, must be {wanted}")
        elif wanted is not None:
            wanted = self.reader.clip(message, signal, wanted)
            if abs(found - wanted) > self.reader.bit(message, signal) * (1 + 1e-9):
                self.fault(time, message, f"{signal} is {found}, must be {wanted}")

    def counter(self, time, message, values):
        """Checks that a protected message counts its frames, up to 14 (profile 1) or 255 (profile 5)."""
        if "E2eCounter" not in values:
            return
        last = self.counters.get(message)
        self.counters[message] = counter = values["E2eCounter"]
        limit = 256 if self.reader.signals["PACKWATCH_" + message, "E2eCounter"].length == 8 else 15
        if last is not None and counter != (last + 1) % limit:
            self.fault(time, message, f"E2eCounter is {counter} after {last}")
        self.values[f"{message}.E2eCounter"] += 1


def compare(reader, life, estimates, events, frame_list):
    rules = {code: snake(str(word)) for code, word in reader.signals["PACKWATCH_Alarm", "Rule"].choices.items()}
    result = Comparison(reader, rules)
    pending = defaultdict(list)  # by time: alarm events that still need an immediate frame
    for event in events:
        if event["event"] == "alarm":
            pending[event["time"]].append(event)
    periods = [event["seconds"] for event in events if event["event"] == "recharge_period"]
    done = 0
    estimate, event = 0, 0
    for time, frame_id, data in frame_list:
        # Reports with the frame's own time were processed before the frame.
        while estimate < len(estimates) and estimates[estimate][0] <= time:
            life.take_estimate(estimates[estimate][1])
            estimate += 1
        while event < len(events) and events[event]["time"] <= time:
            done += events[event]["event"] == "recharge_period"
            life.take_event(events[event])
            event += 1
        message, values = reader.decode(frame_id, data)
        result.frames[message] += 1
        result.counter(time, message, values)
        if message == "Status":
            for signal, wanted in life.status().items():
                result.value(time, message, signal, values[signal], wanted)
        elif message == "Health":
            for signal, wanted in life.health().items():
                if signal in values:
                    if signal == "RechargePeriod" and values[signal] is not None:
                        # As soon as the SOC passes the upper end of the recharge window, the frame contains the new
                        # period. The event follows at the end of the charge, if the log contains that end.
                        coming = periods[done] if done < len(periods) else None
                        if coming is not None and abs(values[signal] - coming) <= 1:
                            wanted = coming
                        elif done == len(periods) and abs(values[signal] - (wanted or 0)) > 1:
                            result.unreported += 1
                            continue
                    if signal == "ResistanceRatio" and wanted is not None and values[signal] is not None and life.moved:
                        result.restated += 1
                        continue
                    result.value(time, message, signal, values[signal], wanted)
        elif message == "Digest":
            compare_digest(result, life, time, values)
        else:
            compare_alarm(result, life, time, values, pending)
    for time, left in pending.items():
        for alarm in left:
            result.fault(time, "Alarm", f"no immediate frame for {alarm}")
    return result


def compare_digest(result, life, time, values):
    """The digest's count and worst severity must match the events."""
    if "Raised" in values:
        result.value(time, "Digest", "Raised", values["Raised"], len(life.alarms))
        result.value(time, "Digest", "Worst", values["Worst"], max((SEVERITIES[of] for _, _, of in life.alarms), default=0))


def compare_alarm(result, life, time, values, pending):
    """The first frame after an alarm event must match that event. All other frames repeat alarms that are raised or
    unknown, or that changed earlier."""
    rule, cell = result.rules[values["Rule"]], values["Cell"]
    severity = {number: word for word, number in SEVERITIES.items()}[values["Severity"]]
    name = next(signal for signal in values if signal.startswith("Value_"))
    threshold = name.replace("Value_", "Threshold_")
    factor = 100 if result.reader.signals["PACKWATCH_Alarm", name].unit == "%" else 1
    key = rule, cell, severity
    # If more alarms change than the frame budget allows, their frames follow one after another, each with the present
    # state.
    waiting = [(at, e) for at in pending if time - WAIT_NS <= at <= time for e in pending[at] if (e["rule"], e["cell"], e["severity"]) == key]
    at_once = waiting[-1][1] if waiting else None
    result.value(time, "Alarm", "Test", values["Test"], 0)
    event = at_once or life.alarms.get(key)
    if at_once:
        for at, past in waiting:
            pending[at].remove(past)
        if waiting[-1][0] == time:
            result.value(time, "Alarm", name, values[name], scaled(at_once["value"], factor))
        result.frames["Alarm at once"] += 1
    elif event and rule == "capacity_low" and values["State"] == STATES["active"]:
        result.value(time, "Alarm", name, values[name], life.capacity[cell][0])
    if event:
        result.value(time, "Alarm", "State", values["State"], STATES[event["state"]])
        result.value(time, "Alarm", "Acknowledged", values["Acknowledged"], event["acknowledged"])
        result.value(time, "Alarm", threshold, values[threshold], factor * event["threshold"])
    elif values["State"] == STATES["unknown"]:
        # The alarm is not raised, but the daemon does not know whether it should be.
        result.value(time, "Alarm", name, values[name], None)
        result.frames["Alarm unknown"] += 1
    elif key in life.changed:
        result.value(time, "Alarm", "State", values["State"], STATES[life.changed[key]["state"]])
        result.frames["Alarm repeated"] += 1
    elif values["State"] == STATES["inactive"]:
        # The alarm was announced as unknown before.
        result.frames["Alarm known again"] += 1
    else:
        result.fault(time, "Alarm", f"{key} was sent but is not raised")


def main():
    dbc, frame_log, estimate_csv, event_log, rated_ah = sys.argv[1:]
    with open(estimate_csv) as rows:
        estimates = [(nanos(row["time_s"]), row) for row in csv.DictReader(rows)]
    with open(event_log) as lines:
        events = [json.loads(line) for line in lines]
    life = Life(len({row["cell"] for _, row in estimates}), float(rated_ah))
    result = compare(Reader(dbc), life, estimates, events, frames(frame_log))
    for line in result.printed:
        print(line)
    print(json.dumps({"faults": result.faults, "cells": life.cells, "frames": dict(result.frames),
                      "values": sum(result.values.values()), "unreported": result.unreported, "restated": result.restated, "per_signal": dict(result.values)}))
    sys.exit(result.faults != 0)


if __name__ == "__main__":
    main()
