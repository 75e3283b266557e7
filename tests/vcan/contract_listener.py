"""An independent ECU that listens to packwatch and keeps the table of raised alarms. It uses only the DBC and
docs/src/ecu/contract.md.

    listener = ContractListener("out.dbc", loss=0.1, seed=1)
    listener.handle(time_s, frame_id, data)     call this for each frame of the bus; ignores a random part (`loss`) of them
    listener.table(now_s)                       {(rule, severity, cell): (state, acknowledged)}
    listener.is_confirmed(now_s)                whether the table agrees with the digest (count and checksum of alarms)
"""

import binascii
import random

import cantools

CYCLE_PASSES, TIMEOUT_PASSES = 4, 7
DIGEST_TIMEOUT_S = 3.0
RAISED = ("active", "latched", "suppressed")
WHOLE_PACK = 2047


def checksum(table):
    """Returns the sum of the CRC-16 of all entries."""
    total = 0
    for (rule, severity, cell), (state, acknowledged) in table.items():
        entry = bytes([rule, severity, cell & 0xFF, cell >> 8, state + 8 * acknowledged])
        total += binascii.crc_hqx(entry, 0xFFFF)
    return min(total % 65536, 65534)


class ContractListener:
    def __init__(self, dbc, loss=0.0, seed=0):
        database = cantools.database.load_file(dbc, strict=True)
        self.alarm = database.get_message_by_name("PACKWATCH_Alarm")
        self.digest = database.get_message_by_name("PACKWATCH_Digest")
        self.loss, self.random = loss, random.Random(seed)
        self.entries = {}
        self.pass_s = self.alarm.cycle_time / 1000
        self.wanted, self.digest_s = None, None
        self.rules = {}

    def handle(self, time_s, frame_id, data):
        if self.random.random() < self.loss:
            return
        if frame_id == self.alarm.frame_id:
            self.handle_alarm(time_s, self.alarm.decode(data, decode_choices=False))
        elif frame_id == self.digest.frame_id:
            self.handle_digest(time_s, self.digest.decode(data, decode_choices=False))

    def handle_alarm(self, time_s, values):
        if values["Test"]:
            return
        key = values["Rule"], values["Severity"], values["Cell"]
        if str(self.choice(self.alarm, "State", values["State"])) in RAISED:
            self.entries[key] = values["State"], values["Acknowledged"], time_s
        else:
            self.entries.pop(key, None)

    def handle_digest(self, time_s, values):
        self.digest_s = time_s
        page = str(self.choice(self.digest, "Page", values["Page"]))
        if page == "alarms":
            self.wanted = values["Raised"], values["TableChecksum"]
            self.pass_s = values["PassTime"]
        elif page in ("rules", "rules_2"):
            for number, name in self.alarm.get_signal_by_name("Rule").choices.items():
                if f"Rule_{name}" in values:
                    self.rules[number] = str(self.choice(self.digest, f"Rule_{name}", values[f"Rule_{name}"]))
            over = [key for key in self.entries if self.rules.get(key[0]) in ("none", "unknown", "not watched")]
            for key in over:
                del self.entries[key]

    @staticmethod
    def choice(message, signal, code):
        return message.get_signal_by_name(signal).choices[code]

    def cycle_s(self):
        return CYCLE_PASSES * self.pass_s

    def table(self, now_s):
        for key in [key for key, (_, _, at_s) in self.entries.items() if now_s - at_s > TIMEOUT_PASSES * self.pass_s]:
            del self.entries[key]
        return {key: (state, acknowledged) for key, (state, acknowledged, _) in self.entries.items()}

    def is_confirmed(self, now_s):
        if self.digest_s is None or now_s - self.digest_s > DIGEST_TIMEOUT_S:
            return False
        table = self.table(now_s)
        return self.wanted == (min(len(table), 4094), checksum(table))
