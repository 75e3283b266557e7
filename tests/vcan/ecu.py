#!/usr/bin/env python3
"""A controller that answers diagnostic requests, using PyPI `can-isotp` as an independent implementation.

    ecu.py INTERFACE [--answers DID=HEX ...]     requests on 7E4, answers on 7EC, until SIGTERM

Rejects a request for an unknown identifier with 0x31. Prints "ready", then each request.
"""

import argparse

import can
import isotp

REQUEST, ANSWER = 0x7E4, 0x7EC
OUT_OF_RANGE = 0x31


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("interface")
    parser.add_argument("--answers", nargs="+", default=[])
    options = parser.parse_args()
    known = {int(did, 16): bytes.fromhex(data) for did, data in (pair.split("=") for pair in options.answers)}
    bus = can.Bus(interface="socketcan", channel=options.interface, can_filters=[{"can_id": REQUEST, "can_mask": 0x7FF}])
    address = isotp.Address(isotp.AddressingMode.Normal_11bits, rxid=REQUEST, txid=ANSWER)
    stack = isotp.CanStack(bus, address=address, params={"tx_padding": 0xAA, "blocking_send": False})
    stack.start()
    print("ready", flush=True)
    while True:
        request = stack.recv(block=True, timeout=1)
        if not request:
            continue
        print(request.hex(), flush=True)
        identifier = int.from_bytes(request[1:3], "big")
        if request[0] == 0x22 and identifier in known:
            stack.send(bytes([0x62]) + request[1:3] + known[identifier])
        else:
            stack.send(bytes([0x7F, request[0], OUT_OF_RANGE]))


if __name__ == "__main__":
    main()
