"""The Python peer of the parsing comparison: python-can's log reader and cantools.

parse.py LOG DBC [FRAMES]      prints: frames sum seconds
"""
import itertools
import sys
import time

import can
import cantools


def main():
    log, dbc = sys.argv[1:3]
    most = int(sys.argv[3]) if len(sys.argv) > 3 else None
    database = cantools.database.load_file(dbc)
    frames, total, start = 0, 0.0, time.perf_counter()
    for message in itertools.islice(can.LogReader(log), most):
        for value in database.decode_message(message.arbitration_id, message.data, decode_choices=False).values():
            total += value
        frames += 1
    print(frames, f"{total:.6f}", f"{time.perf_counter() - start:.6f}")


main()
