# shellcheck shell=bash
# Helpers for vcan tests in bash:   . "$(dirname "$0")/lib.sh"
# If an assertion or a command fails, the test ends with status 1 and shows the logs of all started programs. $tmp is the test's folder.
set -euo pipefail

tmp=$(mktemp -d)
declare -A pids=()
# shellcheck disable=SC2034  # for the tests
exit_status='' # exit status of the last process that `stop` or `wait_exit` waited for

at_exit() {
    local status=$? name
    # wait: keeps bash from announcing each killed process.
    for name in "${!pids[@]}"; do { kill -KILL "${pids[$name]}" && wait "${pids[$name]}"; } 2>/dev/null || true; done
    if [[ $status != 0 && $status != 77 ]]; then
        for name in "$tmp"/*.log; do
            [[ ! -s $name ]] || { echo "--- ${name##*/} (last 40 lines)" && tail -n 40 "$name"; } >&2
        done
    fi
    rm -rf "$tmp"
}
trap at_exit EXIT

# fail MESSAGE...
fail() {
    echo "FAIL ${BASH_SOURCE[-1]##*/}:${BASH_LINENO[-2]}: $*" >&2
    exit 1
}

# skip MESSAGE...: this machine lacks something that the test needs.
skip() {
    echo "SKIP $*" >&2
    exit 77
}

# assert_eq WANTED FOUND WHAT
assert_eq() {
    [[ $1 == "$2" ]] || fail "$3:"$'\n'"wanted: $1"$'\n'"found:  $2"
}

# Milliseconds of a clock that never steps. (The test may step the wall clock.)
now_ms() {
    local uptime _
    read -r uptime _ </proc/uptime
    echo $((10#${uptime/./} * 10))
}

# wait_for SECONDS WHAT COMMAND...: repeats COMMAND until it succeeds.
wait_for() {
    local deadline=$(($(now_ms) + $1 * 1000)) seconds=$1 what=$2
    shift 2
    until "$@"; do
        (($(now_ms) < deadline)) || fail "no $what after $seconds s ($*)"
        sleep 0.05
    done
}

# start NAME COMMAND...: runs COMMAND in the background with output to $tmp/NAME.log.
start() {
    local name=$1
    shift
    [[ -z ${pids[$name]-} ]] || fail "start $name: already started"
    "$@" </dev/null >"$tmp/$name.log" 2>&1 &
    pids[$name]=$!
}

running() { kill -0 "${pids[$1]}" 2>/dev/null; }
ended() { ! running "$1"; }

# wait_exit NAME SECONDS: waits until NAME ends by itself. Sets $exit_status.
wait_exit() {
    wait_for "$2" "end of $1" ended "$1"
    # shellcheck disable=SC2034
    exit_status=0
    # shellcheck disable=SC2034
    wait "${pids[$1]}" || exit_status=$?
    unset "pids[$1]"
}

# stop NAME [SIGNAL]: sends the signal (TERM) and waits up to 10 s. Sets $exit_status.
stop() {
    kill -"${2-TERM}" "${pids[$1]}" 2>/dev/null || fail "stop $1: it had already ended"
    wait_exit "$1" 10
}

# logged NAME REGEX: whether NAME's log has a line that matches the extended regular expression.
logged() { grep -qE -- "$2" "$tmp/$1.log"; }
# caught_up NAME: sends a frame that no other node uses to vcan0. Succeeds if candump NAME has received this frame, and
# so all earlier frames.
caught_up() { cansend vcan0 7FF#0123 && logged "$1" '7FF#0123'; }

iface_add() { ip link add dev "$1" mtu 72 type vcan && ip link set dev "$1" up; }
iface_delete() { ip link delete dev "$1"; }
iface_up() { ip link set dev "$1" up; }
iface_down() { ip link set dev "$1" down; }

# receiving IFACE COUNT: whether the kernel lists at least COUNT receive filters on IFACE ("any": filters of sockets
# that are not bound to an interface). If a frame is sent before its receiver is listed, it is lost. candump prints
# nothing when it is ready, so wait:
#   start dump candump -L vcan0; wait_for 5 "receiver on vcan0" receiving vcan0 1
receiving() {
    awk -v iface="$1" -v wanted="$2" '$1 == iface && NF == 7 { n++ } END { exit n < wanted }' /proc/net/can/rcvlist_*
}
