# shellcheck shell=bash
# Helpers for tests of `packwatch run`:   . "$(dirname "$0")/lib.sh"; . "$(dirname "$0")/daemon.sh"
# Every daemon NAME has $tmp/NAME.journal, .sent (its --frames), .events, .json (its snapshot) and .log.

packwatch=${PACKWATCH_BIN:?names the program under test}
# A copy of config/, for the tests' own configurations beside it.
config=$tmp/config
cp -r "$(dirname "${BASH_SOURCE[0]}")/../../config" "$config"

# daemon NAME CONFIG ARGS...: without a control socket, unless ARGS say where: a packwatch of this machine's own may have
# the usual one.
daemon() {
    local name=$1 file=$2 base=$tmp/$1
    shift 2
    [[ " $* " == *" --control "* ]] || set -- --control none "$@"
    [[ " $* " == *" --state "* ]] || set -- --state none "$@"
    [[ " $* " == *" --status "* ]] || set -- --status none "$@"
    start "$name" "$packwatch" run -c "$file" --record "$base.journal" --frames "$base.sent" --events "$base.events" \
        --snapshot "$base.json" "$@"
}

# daemon_stopped NAME: stops it; anything but a clean end fails the test.
daemon_stopped() {
    stop "$1"
    assert_eq 0 "$exit_status" "status of $1 after SIGTERM"
}

# Has the log of NAME COUNT or more lines with the expression?
logged_times() { (($(grep -cE -- "$2" "$tmp/$1.log") >= $3)); }

# Has the journal of NAME a line with the expression? It reaches the disk within a second.
journalled() { grep -qE -- "$2" "$tmp/$1.journal"; }
journalled_times() { (($(grep -cE -- "$2" "$tmp/$1.journal") >= $3)); }

# ID#DATA of the frames on an interface in a candump log or journal.
frames_of() { awk -v on="$2" '$1 ~ /^\(/ && $2 == on { print $3 }' "$1"; }

# Sum of the last words of the lines with the expression: frames dropped, frames not sent.
sum_of() { awk -v wanted="$2" '$0 ~ wanted { n += $NF } END { print n + 0 }' "$1"; }

# replayed NAME CONFIG ARGS...: the journal of NAME, replayed, must give the frames and events of NAME, byte for byte.
replayed() {
    local name=$1 file=$2 base=$tmp/$1 what
    shift 2
    "$packwatch" replay -c "$file" --frames "$base.again.sent" --events "$base.again.events" "$@" "$base.journal" \
        >"$tmp/$name.replay.log" 2>&1 || fail "replay of $name: status $?"
    for what in sent events; do
        cmp "$base.$what" "$base.again.$what" || fail "replay of $name: other $what than live"
    done
}

# restart_bar LOG...: how far a restarted daemon may be from one that kept running, in points. 0.2, and on a machine on which a restart
# takes more than 2.5 s (the logs say how long it was away) what the drive's largest current moves meanwhile unseen: 6.2 A of
# 2.6 Ah are 0.066 points a second. A tenth on top, for the time between the last sample seen and the state's stamp.
restart_bar() {
    cat -- "$@" | sed -nE 's/.*state (taken up|restored).* away=([0-9.]+).*/\2/p' |
        awk '$1 > away { away = $1 } END { print (away > 2.5 ? 0.073 * away + 0.02 : 0.2) }'
}
