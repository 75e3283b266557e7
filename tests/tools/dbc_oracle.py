"""Decodes payloads with cantools: reads `name hex` lines, answers one line each of `signal=repr(value)` pairs.

usage: dbc_oracle.py FILE.dbc [strict]
"""
import sys
import cantools

db = cantools.database.load_file(sys.argv[1], strict=len(sys.argv) > 2)
# cantools puts long names (over 32 characters) in the place of those the file defines.
messages = {m.name[:32]: m for m in db.messages}
for line in sys.stdin:
    name, payload = line.split()
    try:
        message = messages[name[:32]]
        values = message.decode(
            bytes.fromhex(payload), decode_choices=False, scaling=True, allow_truncated=True)
        print("\t".join(f"{k[:32]}={v!r}" for k, v in values.items()))
    except Exception as error:  # an unknown page: nothing is said about this payload
        print(f"!{type(error).__name__}")
