#!/usr/bin/env python3
"""Sends and receives ISO-TP messages with PyPI `can-isotp`, for tests/integration/isotp_peer.rs.

        isotp_oracle.py send       reads one message per line (hex); prints its frames on one line (hex, separated by blanks)
        isotp_oracle.py receive    the reverse: reads frames, prints the message
"""

import sys
from collections import deque

import isotp

SENDER = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7EC, rxid=0x7E4)
RECEIVER = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7E4, rxid=0x7EC)
PARAMETERS = {"tx_padding": 0xCC, "stmin": 0, "blocksize": 0}


def layer(address: isotp.Address, inbox: deque, outbox: deque) -> isotp.TransportLayerLogic:
    receive = lambda timeout=0: inbox.popleft() if inbox else None  # noqa: E731
    return isotp.TransportLayerLogic(rxfn=receive, txfn=outbox.append, address=address, params=PARAMETERS)


def frames_of(message: bytes) -> list[bytes]:
    """Returns the sender's frames. A receiver sends the flow control."""
    to_receiver, to_sender, frames = deque(), deque(), []
    sender, receiver = layer(SENDER, to_sender, to_receiver), layer(RECEIVER, to_receiver, to_sender)
    sender.send(message)
    while not receiver.available():
        sender.process()
        frames += [bytes(frame.data) for frame in to_receiver]
        receiver.process()
    assert receiver.recv() == message
    return frames


def message_of(frames: list[bytes]) -> bytes:
    inbox, outbox = deque(isotp.CanMessage(arbitration_id=0x7EC, data=frame) for frame in frames), deque()
    receiver = layer(RECEIVER, inbox, outbox)
    while inbox:
        receiver.process()
    return receiver.recv() or b""


def main() -> None:
    for line in sys.stdin:
        parts = [bytes.fromhex(part) for part in line.split()]
        if sys.argv[1] == "send":
            print(" ".join(frame.hex() for frame in frames_of(parts[0])))
        else:
            print(message_of(parts).hex())


if __name__ == "__main__":
    main()
