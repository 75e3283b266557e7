"""Decodes frames with cantools, and reads bit positions directly from a DBC.

usage: dbc_oracle.py FILE.dbc decode [strict]   reads lines `message hex`; answers each line with a line of
                                                `signal=repr(value)` pairs, or `!reason` if cantools rejects the payload;
                                                omits signals that extend past their message
       dbc_oracle.py FILE.dbc short             answers `message.signal` for each signal that extends past its
                                                message; counts the bits in the file's text, without cantools
       dbc_oracle.py FILE.dbc count             answers `messages signals`, as cantools counts them
       dbc_oracle.py FILE.dbc encode [strict]   reads `message signal=value ...` lines, where a value is a number or a
                                                word of the value table; answers the payload in hex
       dbc_oracle.py FILE.dbc about [strict]    answers `message id extended fd brs length cycle_ms profile data_id`
"""
import re
import sys


def last_byte(start, length, big_endian):
    """Returns the number of the highest byte that contains a bit of the signal, by walking from its start bit."""
    bit, highest = start, start // 8
    for _ in range(length - 1):
        if not big_endian:
            bit += 1
        elif bit % 8:
            bit -= 1
        else:
            bit += 15  # from a byte's lowest bit to the next byte's highest
        highest = max(highest, bit // 8)
    return highest


def reaches_past(path):
    """Yields (message, bytes in the message, signal, bytes needed) for each signal that extends past its message."""
    message = None
    with open(path, encoding="latin-1") as text:
        for line in text:
            if found := re.match(r"BO_ +\d+ +(\w+) *: *(\d+) ", line):
                message, size = found[1], int(found[2])
            elif found := re.match(r"\s+SG_ +(\w+) .*?: *(\d+)\|(\d+)@([01])[+-]", line):
                needed = last_byte(int(found[2]), int(found[3]), found[4] == "0") + 1
                if needed > size:
                    yield message, size, found[1], needed


def load(path, strict):
    """The DBC as cantools reads it, with the file's own names.

    If a file gives long names (over 32 characters), cantools renames a multiplexor but not the references to it, and
    cannot decode the dependent signals. Therefore the attributes with the long names are removed.
    """
    import cantools

    with open(path, encoding="latin-1") as text:
        lines = [line for line in text if not re.match(r'BA_ +"System\w+LongSymbol"', line)]
    return cantools.database.load_string("".join(lines), "dbc", strict=strict)


def decode(path, strict):
    messages = {m.name: m for m in load(path, strict).messages}
    past = list(reaches_past(path))
    for name, _, _, needed in past:
        # cantools cannot decode a message that has a signal past its end. Lengthen the message and omit these signals.
        message = messages[name]
        message.length = max(message.length, needed)
        message.refresh(strict=False)
    left_out = {(name, signal) for name, _, signal, _ in past}
    for line in sys.stdin:
        name, payload = line.split()
        try:
            message = messages[name]
            data = bytes.fromhex(payload).ljust(message.length, b"\0")
            values = message.decode(data, decode_choices=False, scaling=True)
            print("\t".join(f"{k}={v!r}" for k, v in values.items() if (name, k) not in left_out))
        except Exception as error:  # for example an unknown multiplexer value
            print(f"!{type(error).__name__}: {error}".replace("\n", " "))


def count(path):
    messages = load(path, False).messages
    print(len(messages), sum(len(m.signals) for m in messages))


def encode(path, strict):
    messages = {m.name: m for m in load(path, strict).messages}
    for line in sys.stdin:
        name, *pairs = line.split()
        values = dict(pair.split("=") for pair in pairs)
        values = {k: int(v) if v.isdigit() else v for k, v in values.items()}
        print(messages[name].encode(values, scaling=True, strict=strict).hex())


def about(path, strict):
    for m in load(path, strict).messages:
        attributes = m.dbc.attributes

        def value(name):
            """The attribute's word or number, or a dash if it has the default."""
            found = attributes.get(name)
            if found is None:
                return "-"
            words = found.definition.choices
            return words[found.value] if words and isinstance(found.value, int) else found.value

        brs = value("CANFD_BRS")
        print(m.name, m.frame_id, int(m.is_extended_frame), int(m.is_fd), 0 if brs == "-" else brs, m.length,
              m.cycle_time, value("E2EProfile"), value("E2EDataId"))


if sys.argv[2] == "encode":
    encode(sys.argv[1], strict=len(sys.argv) > 3)
elif sys.argv[2] == "about":
    about(sys.argv[1], strict=len(sys.argv) > 3)
elif sys.argv[2] == "short":
    for name, _, signal, _ in reaches_past(sys.argv[1]):
        print(f"{name}.{signal}")
elif sys.argv[2] == "count":
    count(sys.argv[1])
else:
    decode(sys.argv[1], strict=len(sys.argv) > 3)
