# shellcheck shell=bash
# Helpers for tests of faults:   . "$(dirname "$0")/lib.sh"; . "$(dirname "$0")/daemon.sh"; . "$(dirname "$0")/faults.sh"
# A daemon with its state on disk learns from fast_pack (a simulated pack in fast motion) while faults occur. Each test
# prints one line per fault. At the end, it compares the store with the events that the daemon has reported.

# State folder of the daemon `main`. A test with its own disk overrides this path.
state=$tmp/state
here=$(dirname "${BASH_SOURCE[0]}")
fast=$tmp/fast
tools() { python3 "$here/fault_tools.py" "$@"; }

# pack SECONDS: writes fast_pack's files to $fast.
pack() { "$here/fast_pack" "$fast" --seconds "$1"; }

# feed: continues to play the pack on vcan0. dump.log contains the pack's samples and packwatch's frames of all feeds.
feed() {
    if [[ -z ${pids[dump]-} ]]; then
        start dump candump -L any,6B0:7F0,7F0:7FE
        wait_for 5 "receiver" receiving any 1
    fi
    start feed python3 "$here/fault_tools.py" play "$fast/pack.log" vcan0 --from "$(sample)"
}
unfed() { stop feed; }
sample() {
    local last
    last=$(grep -oE ' 7F0#[0-9A-F]{8}$' "$tmp/dump.log" | tail -n 1) || true
    last=${last#*#}
    echo $((16#${last:-0}))
}

# again WHAT...: starts the daemon `main` again, for example after `stop main`. Its earlier reports still count.
runs=0
again() {
    local file
    for file in "$tmp"/main.*; do [[ ! -e $file ]] || mv "$file" "$tmp/main-$runs.${file##*.}"; done
    runs=$((runs + 1))
    daemon main "$@"
}

# ---- what was learned ----------------------------------------------------------------------------------------------------------------

# reported EVENT: number of such events that the daemon `main` has reported in all its runs.
reported() { cat "$tmp"/main*.events | grep -E "\"event\":\"$1\"" | grep -cvE '"measured_ah":null|"change":"(suppressed|resumed)"' || true; }
# Number of reported capacities, half-cycles, and alarms raised or cleared.
reported_all() { echo "$(reported capacity) $(reported half_cycle) $(reported alarm)"; }
reported_more() { (($(reported "$1") >= $2)); }
learned_more() { reported_more half_cycle "$1"; }

# fault NAME: marks the start of a fault.
fault() {
    fault_name=$1 fault_before=$(reported_all)
    running main || fail "$fault_name: the daemon is not running before the fault"
}

# survived WHAT...: marks the end of the fault. The same process must keep learning, and must have stored all its
# reports.
survived() {
    local stored after
    running main || fail "$fault_name: the daemon ended"
    wait_for 15 "learning after $fault_name" learned_more $(($(reported half_cycle) + 4))
    after=$(reported_all)
    stored=$(tools learned "$state" "$tmp"/main*.events 2>"$tmp/learned.err") || fail "$fault_name: $(cat "$tmp/learned.err")"
    echo "$fault_name: $*; learned (capacities, half-cycles, alarms): before $fault_before, after $after, stored $stored"
}

# all_stored: call at the end. The store must contain exactly the reported values and a valid chain.
all_stored() {
    local stored
    stored=$(tools learned "$state" "$tmp"/main*.events --exactly 2>"$tmp/learned.err") || fail "at the end: $(cat "$tmp/learned.err")"
    "$packwatch" history verify --state "$state" >"$tmp/verify.log" 2>&1 || fail "history verify: $(cat "$tmp/verify.log")"
    echo "at the end: reported (capacities, half-cycles, alarms) $(reported_all) = stored $stored; history verify: $(tail -n 1 "$tmp/verify.log")"
}
