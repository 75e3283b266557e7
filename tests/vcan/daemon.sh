# shellcheck shell=bash
# Helpers for tests of `packwatch run`:   . "$(dirname "$0")/lib.sh"; . "$(dirname "$0")/daemon.sh"
# Every daemon NAME writes $tmp/NAME.journal, .sent (its --frames), .events, .json (its snapshot) and .log.

packwatch=${PACKWATCH_BIN:?names the program under test}
# A copy of config/, to which the tests add their own configurations.
config=$tmp/config
cp -r "$(dirname "${BASH_SOURCE[0]}")/../../config" "$config"

# daemon NAME CONFIG ARGS...: runs without control socket, status socket and state folder unless ARGS name them. An
# installed packwatch may use the default sockets and the default folder.
daemon() {
    local name=$1 file=$2 base=$tmp/$1
    shift 2
    [[ " $* " == *" --control "* ]] || set -- --control none "$@"
    [[ " $* " == *" --state "* ]] || set -- --state none "$@"
    [[ " $* " == *" --status "* ]] || set -- --status none "$@"
    start "$name" "$packwatch" run -c "$file" --record "$base.journal" --frames "$base.sent" --events "$base.events" \
        --snapshot "$base.json" "$@"
}

# daemon_stopped NAME: stops the daemon. Fails unless it ends cleanly.
daemon_stopped() {
    stop "$1"
    assert_eq 0 "$exit_status" "status of $1 after SIGTERM"
}

# Whether NAME's log has at least COUNT lines with the expression.
logged_times() { (($(grep -cE -- "$2" "$tmp/$1.log") >= $3)); }

# Whether NAME's journal has a line with the expression.
journalled() { grep -qE -- "$2" "$tmp/$1.journal"; }
journalled_times() { (($(grep -cE -- "$2" "$tmp/$1.journal") >= $3)); }

# frames_of FILE INTERFACE: prints ID#DATA of the frames in a candump log or journal.
frames_of() { awk -v on="$2" '$1 ~ /^\(/ && $2 == on { print $3 }' "$1"; }

# sum_of FILE EXPRESSION: sum of the last words of all matching lines.
sum_of() { awk -v wanted="$2" '$0 ~ wanted { n += $NF } END { print n + 0 }' "$1"; }

# replayed NAME CONFIG ARGS...: a replay of NAME's journal must give NAME's frames and events, byte for byte.
replayed() {
    local name=$1 file=$2 base=$tmp/$1 what
    shift 2
    "$packwatch" replay -c "$file" --frames "$base.again.sent" --events "$base.again.events" "$@" "$base.journal" \
        >"$tmp/$name.replay.log" 2>&1 || fail "replay of $name: status $?"
    for what in sent events; do
        cmp "$base.$what" "$base.again.$what" || fail "replay of $name: other $what than live"
    done
}

# restart_bar LOG...: prints the allowed difference between the SOC of a restarted daemon and the SOC of a daemon that
# kept running, in percentage points. If all restarts took at most 2.5 s, 0.2 points are allowed. Otherwise, the largest
# SOC change during the longest restart is allowed: a current of 6.2 A changes the SOC of a 2.6 Ah cell by 0.066 points
# a second. A tenth of this and 0.02 points are added for the time between the last sample and the state's time stamp.
restart_bar() {
    cat -- "$@" | sed -nE 's/.*state (taken up|restored).* away=([0-9.]+).*/\2/p' |
        awk '$1 > away { away = $1 } END { print (away > 2.5 ? 0.073 * away + 0.02 : 0.2) }'
}
