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

# ---- what was learned ----------------------------------------------------------------------------------------------------------------

# told EVENT: how many the daemon `main` has told, in all its runs.
told() { cat "$tmp"/main*.events | grep -cE "\"event\":\"$1\"" || true; }
# Capacities, half-cycles, alarms raised or cleared: told.
told_all() { echo "$(told capacity) $(told half_cycle) $(told alarm)"; }
# Of this run's capacities, COUNT or more?
learned_more() { (($(told capacity) >= $1)); }

# fault NAME: from here on it happens.
fault() {
    fault_name=$1 fault_before=$(told_all)
    running main || fail "$fault_name: the daemon is not running before"
}

# survived WHAT...: it is over; the daemon must be the same one, learn on, and have stored what it told.
survived() {
    running main || fail "$fault_name: the daemon ended"
    wait_for 15 "learning after $fault_name" learned_more $(($(told capacity) + 4))
    echo "$fault_name: $*; learned (capacities, half-cycles, alarms) before $fault_before, after $(told_all)$(stored)"
}
# TODO with the store
stored() { :; }
