# shellcheck shell=bash
# Helpers for tests of faults:   . "$(dirname "$0")/lib.sh"; . "$(dirname "$0")/daemon.sh"; . "$(dirname "$0")/faults.sh"
# A daemon with its state on disk learns from fast_pack's pack while something happens to it. Each test tells, a line per fault,
# what happened and what was learned, and in the end holds the store against what was told.

here=$(dirname "${BASH_SOURCE[0]}")
fast=$tmp/fast
tools() { python3 "$here/fault_tools.py" "$@"; }

# pack SECONDS: fast_pack's files in $fast; $fast/fast.toml is the daemon's.
pack() {
    "$here/fast_pack" "$fast" --seconds "$1"
    pack_at=''
}

# feed [INTERFACE]: the pack on the bus, from now on, whatever becomes of the interface. What is told of it: dump.log.
feed() {
    start dump candump -L "${1-vcan0},6B0:7F0,7F0:7FF"
    wait_for 5 "receiver" receiving "${1-vcan0}" 1
    start feed python3 "$here/fault_tools.py" play "$fast/pack.log" "${1-vcan0}"
}
# The number of the sample that was last on the bus.
sample() { echo $((16#$(grep -oE ' 7F0#[0-9A-F]+' "$tmp/dump.log" | tail -n 1 | cut -d '#' -f 2 || echo 0))); }
