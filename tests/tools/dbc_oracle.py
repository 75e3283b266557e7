"""Decodes payloads with cantools: reads `name hex` lines, answers one line each of `signal=value` pairs.

usage: dbc_oracle.py FILE.dbc [strict]

Long names (`SystemSignalLongSymbol` and its like) are left out: cantools renames the multiplexor but not what its
pages refer to, and then loses those pages.
"""
import sys

import cantools

with open(sys.argv[1], encoding="cp1252") as file:
    text = "".join(line for line in file if not (line.startswith("BA_ ") and "LongSymbol" in line))
db = cantools.database.load_string(text, "dbc", strict=len(sys.argv) > 2)
for line in sys.stdin:
    name, payload = line.split()
    message = db.get_message_by_name(name)
    try:
        values = message.decode(bytes.fromhex(payload), decode_choices=False, scaling=True, allow_truncated=True)
        print("\t".join(f"{k}={v!r}" for k, v in values.items()))
    except cantools.database.DecodeError as error:  # a page the DBC does not have: nothing is said about this payload
        print(f"!{error}")
