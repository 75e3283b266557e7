"""Protects and checks payloads end to end with autosar-e2e and, for profile 5, with cantools.

usage: e2e_oracle.py   reads lines `profile data_id raw ours flipped` with payloads in hex:
                         raw       before protection, with the previous counter
                         ours      as packwatch protects it, with the next counter
                         flipped   `ours` with one bit wrong
                       Answers each line with `peer ours? flipped? [peer ours? flipped?]`:
                         peer      `raw` as the peer protects it
                         ours?     1 if the peer accepts `ours`, otherwise 0
                         flipped?  1 if the peer accepts `flipped`, otherwise 0
                       The first three words come from autosar-e2e, which advances the counter itself. The words in
                       brackets come from cantools, only for profile 5 and payloads of at least 4 bytes. cantools does
                       not advance the counter, so its `raw` contains packwatch's counter.
"""
import sys

from cantools.autosar import apply_profile5_crc, check_profile5_crc
from e2e.p01 import E2E_P01_DATAID_BOTH, E2E_P01_DATAID_NIBBLE, e2e_p01_check, e2e_p01_protect
from e2e.p05 import e2e_p05_check, e2e_p05_protect

MODES = {"1A": E2E_P01_DATAID_BOTH, "1C": E2E_P01_DATAID_NIBBLE}


def answer(profile, data_id, raw, ours, flipped):
    peer = bytearray(raw)  # changed in place; the check of profile 1 also needs a mutable object
    if profile == "5":
        e2e_p05_protect(peer, data_id)
        accepted = [e2e_p05_check(payload, data_id) for payload in (ours, flipped)]
    else:
        e2e_p01_protect(peer, data_id, data_id_mode=MODES[profile])
        accepted = [e2e_p01_check(payload, data_id, data_id_mode=MODES[profile]) for payload in (ours, flipped)]
    words = [peer.hex(), *("01"[a] for a in accepted)]
    if profile == "5" and len(raw) >= 4:
        with_counter = raw[:2] + ours[2:3] + raw[3:]
        words.append(apply_profile5_crc(with_counter, data_id).hex())
        words += ["01"[check_profile5_crc(payload, data_id)] for payload in (ours, flipped)]
    return " ".join(words)


for line in sys.stdin:
    profile, data_id, *payloads = line.split()
    print(answer(profile, int(data_id), *(bytearray.fromhex(payload) for payload in payloads)))
