# shellcheck shell=bash
# Runs a real systemd as process 1, for tests of the shipped units:   . "$(dirname "$0")/lib.sh"; . "$(dirname "$0")/systemd.sh"
# It has its own process and mount namespaces, with journald, and with udev on request. Use in a test:
#
#   systemd_prepare paper.toml            # program, units and configuration where the package puts them
#   drop_in packwatch.service test '[Service]' 'WatchdogSec=3s'
#   systemd_boot                          # boots and starts packwatch.service; `systemd_boot UNIT...` starts other units, `systemd_boot ''` none
#   wait_for 20 "active unit" has ActiveState active
#
# The state is in /var/lib, as on a vehicle. It is lost when the user-mode kernel ends. To keep it, mount a disk there
# before `systemd_boot`.

[[ -x /usr/lib/systemd/systemd ]] || skip "no systemd on this machine"
# systemd_prepare writes to /etc, /usr and /var, so run only where these changes are discarded.
grep -q 'User Mode Linux' /proc/cpuinfo || skip "only in the user-mode kernel (PACKWATCH_VCAN=uml): it changes /etc and /usr"

repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
units=$tmp/units # becomes /run/systemd/system: the boot mounts a new /run
mkdir -p "$units"

# systemd_prepare CONFIG: installs config/CONFIG as packwatch.toml. Switches off the units' default dependencies, which
# would start a complete system.
systemd_prepare() {
    install -D "${PACKWATCH_BIN:?names the program under test}" /usr/bin/packwatch
    [[ ! -x ${PACKWATCH_BIN%/*}/packwatch-uplink ]] || install -D "${PACKWATCH_BIN%/*}/packwatch-uplink" /usr/bin/packwatch-uplink
    mkdir -p /etc/packwatch
    cp -r "$repository/config/." /etc/packwatch/
    cp "$repository/config/$1" /etc/packwatch/packwatch.toml
    local unit
    for unit in "$repository"/systemd/*.service; do
        cp "$unit" "$units/"
        drop_in "${unit##*/}" 00-test '[Unit]' DefaultDependencies=no
    done
}

drop_in() {
    local folder=$units/$1.d name=$2
    shift 2
    # Inside the namespace, the folder has another path.
    if [[ -n ${pids[systemd]-} ]]; then
        in_system mkdir -p "/run/systemd/system/${folder##*/}"
        printf '%s\n' "$@" | in_system tee "/run/systemd/system/${folder##*/}/$name.conf" >/dev/null
        in_system systemctl daemon-reload
    else
        mkdir -p "$folder"
        printf '%s\n' "$@" >"$folder/$name.conf"
    fi
}

# with_udev: call this before the boot. Network devices then become units, as on a real system.
with_udev() {
    [[ -x /usr/lib/systemd/systemd-udevd ]] || skip "no udev on this machine"
    printf '%s\n' '[Unit]' DefaultDependencies=no Before=test.target '[Service]' Type=notify \
        ExecStart=/usr/lib/systemd/systemd-udevd \
        "ExecStartPost=/usr/bin/udevadm trigger --action=add --subsystem-match=net --settle" >"$units/test-udev.service"
    printf 'Wants=test-udev.service\nAfter=test-udev.service\n' >>"$units/test.wants"
}

systemd_boot() {
    local wanted="${*-packwatch.service}" deadline
    {
        printf '[Unit]\nDefaultDependencies=no\nWants=systemd-journald.service %s\n' "$wanted"
        [[ ! -f $units/test.wants ]] || cat "$units/test.wants"
    } >"$units/test.target"
    printf '[Journal]\nStorage=volatile\nRuntimeMaxUse=32M\nForwardToConsole=no\nRateLimitIntervalSec=0\n' >/etc/systemd/journald.conf
    start systemd unshare --mount --pid --fork --kill-child --mount-proc bash -c "$(declare -f systemd_init); systemd_init '$units'"
    # The child bash replaces itself with systemd, which creates its private socket later.
    wait_for 20 "systemd" booted
}

booted() { [[ -n $(system_process) ]] && in_system test -S /run/systemd/private; }
system_process() { pgrep -P "${pids[systemd]}" || true; }

systemd_init() {
    # The old /sys belongs to the kernel's first network namespace and does not show the interfaces of the test's network
    # namespace.
    mount -t sysfs sysfs /sys && mount -t tmpfs tmpfs /run && mount -t cgroup2 cgroup2 /sys/fs/cgroup
    mkdir -p /run/systemd && cp -r "$1" /run/systemd/system && rm -f /run/systemd/system/test.wants
    exec env -i container=test PATH="$PATH" /usr/lib/systemd/systemd --system --unit=test.target \
        --log-target=console --show-status=no
}

in_system() { nsenter --target "$(system_process)" --mount --pid "$@"; }
# property NAME [UNIT]
property() { in_system systemctl show "${2-packwatch.service}" --property "$1" --value 2>/dev/null; }
# has NAME VALUE [UNIT]
has() { [[ $(property "$1" "${3-packwatch.service}") == "$2" ]]; }
status_has() { [[ $(property StatusText) =~ $1 ]]; }
journal() { in_system journalctl --quiet --no-pager --unit packwatch.service --output cat "$@"; }
# Do not use grep -q. It ends at the first match, and journalctl would then fail the pipeline with SIGPIPE.
journal_has() { journal | grep -E -- "$1" >/dev/null; }

keep_journal() { [[ -z ${pids[systemd]-} ]] || journal >"$tmp/journal.log" 2>&1 || true; }
trap 'status=$?; set +e; keep_journal; (exit $status); at_exit' EXIT
