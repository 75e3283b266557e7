#!/usr/bin/env python3
"""Runs vcan tests, several in one boot and several boots at a time.

    tests/vcan/run_tests.py [--jobs N] [--smoke] [TEST...]       default: all of tests/vcan/*.test

The first lines of a test state its needs:

    # with-vcan: --timeout 60 --modules slcan      options of with-vcan
    # run-tests: 45 s                              approximate duration; the longest start first
    # run-tests: 45 s, own boot: sets the clock    needs a separate kernel, with the reason
    # run-tests: 12 s, smoke                       `--smoke` (and `tests/all --quick`) runs only these

Each test with --disk, and each test that boots the kernel itself ("with-vcan: on the host"), also has a separate
kernel. The other tests share boots: in each boot, the script in-boot takes the next test from a common queue. Every test
has its own network, processes, mounts and root. If a kernel dies, its current test fails and the next boot continues
with the other tests. If the host's kernel has vcan, each test runs in its own namespaces without a boot.

A test's output is printed in one piece when the test ends. Exit status: 0, or 1 if a test failed.
"""

import argparse
import dataclasses
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Tests mostly wait. Three boots at a time use two cores about half of the time.
JOBS = 3
# Time limit if a test states no limit, s.
DEFAULT_LIMIT_S = 120
# Maximum boot time on a busy machine, s.
BOOT_S = 60
SKIPPED = 77
TIMED_OUT = 124
POLL_S = 0.2


@dataclasses.dataclass(frozen=True)
class VcanTest:
    """A test and its stated needs."""

    path: Path
    options: tuple[str, ...]
    expected_s: int
    needs_own_boot: bool
    is_smoke: bool

    @property
    def name(self) -> str:
        return self.path.name

    def option(self, name: str, default: str) -> str:
        return self.options[self.options.index(name) + 1] if name in self.options else default

    @property
    def limit_s(self) -> int:
        return int(self.option("--timeout", str(DEFAULT_LIMIT_S)))

    @property
    def modules(self) -> set[str]:
        return set(filter(None, self.option("--modules", "").split(",")))


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Outcome of a test. `status` 77 means skipped."""

    name: str
    status: int
    seconds: float
    output: str


Report = Callable[[Outcome], None]
CHILDREN: set[subprocess.Popen] = set()


def environment() -> dict[str, str]:
    """Returns a copy of the environment for a child. Without a copy, the child's start may fail with "Bad address" while
    another thread of tests/all replaces the environment."""
    return dict(os.environ)


def read_head(path: Path) -> VcanTest:
    with open(path) as file:
        head = "".join(line for _, line in zip(range(10), file))
    options = re.search(r"^# with-vcan: *(.*)", head, re.M)
    plan = re.search(r"^# run-tests: *(\d+) s(.*)", head, re.M)
    words = options[1] if options else ""
    on_host = words == "on the host"
    options = () if on_host else tuple(shlex.split(words))
    own_boot = on_host or "--disk" in options or (plan is not None and ", own boot" in plan[2])
    return VcanTest(path, options, int(plan[1]) if plan else DEFAULT_LIMIT_S, own_boot, plan is not None and ", smoke" in plan[2])


def in_user_mode_kernel(modules: set[str]) -> bool:
    """Whether with-vcan boots a kernel on this machine. Raises an error if there is no SocketCAN."""
    probe = [HERE / "with-vcan", "--timeout", str(BOOT_S), "--modules", ",".join(sorted(modules)), "--",
             "grep", "-q", "User Mode Linux", "/proc/cpuinfo"]
    ended = subprocess.run(probe, env=environment(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                           check=False)
    if ended.returncode not in (0, 1):
        raise RuntimeError(ended.stdout)
    return ended.returncode == 0


class Run:
    """All tests of one call. All job threads share it."""

    def __init__(self, tests: Iterable[VcanTest], queue: Path, report: Report, uses_user_mode_kernel: bool):
        tests = sorted(tests, key=lambda test: -test.expected_s)
        self.report, self.queue, self.lock = report, queue, threading.Lock()
        self.alone = [test for test in tests if test.needs_own_boot or not uses_user_mode_kernel]
        self.shared = {test.name: test for test in tests if test not in self.alone}
        self.reported: set[str] = set()
        self.boots = 0
        lines = (f"{test.limit_s} {test.path}\n" for test in self.shared.values())
        (queue / "tests").write_text("".join(lines))

    def job(self, begins_alone: bool) -> None:
        if begins_alone:
            self.run_alone()
        self.run_shared()
        self.run_alone()

    def run_alone(self) -> None:
        while True:
            with self.lock:
                if not self.alone:
                    return
                test = self.alone.pop(0)
            started = time.monotonic()
            status, output = call([HERE / "run-test", test.path])
            self.report(Outcome(test.name, status, time.monotonic() - started, output))

    def unclaimed(self) -> list[VcanTest]:
        return [test for name, test in self.shared.items() if not (self.queue / name).exists()]

    def run_shared(self) -> None:
        """Boots until every test is claimed. One boot is enough unless a kernel dies."""
        while rest := self.unclaimed():
            with self.lock:
                self.boots += 1
                boot = f"boot-{self.boots}"
            modules = set().union(*(test.modules for test in self.shared.values()))
            limit_s = BOOT_S + sum(test.limit_s + 5 for test in rest)
            command = [HERE / "with-vcan", "--timeout", str(limit_s), "--ifaces", "", "--modules", ",".join(sorted(modules)),
                       "--out", self.queue, "--", HERE / "in-boot", self.queue, boot]
            status, output = call(command, self.report_finished)
            self.report_finished()
            if status == 0:
                continue
            self.report_lost(boot, f"{output}the kernel ended (status {status}) while this test ran\n")
            if self.unclaimed() == rest:
                self.report_unclaimed(f"{output}no kernel came up (status {status})\n")

    def report_finished(self) -> None:
        """Reports each test whose status has reached the host."""
        for name in self.shared:
            folder = self.queue / name
            with self.lock:
                if name in self.reported or not (folder / "status").exists() or not (text := (folder / "status").read_text().strip()):
                    continue
                self.reported.add(name)
            status, output = int(text), (folder / "log").read_text(errors="replace")
            if status == TIMED_OUT:
                output += f"stopped: time-out, {self.shared[name].limit_s} s\n"
            self.report(Outcome(name, status, float((folder / "seconds").read_text()), output))

    def report_lost(self, boot: str, output: str) -> None:
        """Fails the test that was running when the kernel of a boot died."""
        for name in self.shared:
            folder = self.queue / name
            if name not in self.reported and (folder / boot).exists():
                self.reported.add(name)
                log = (folder / "log").read_text(errors="replace") if (folder / "log").exists() else ""
                self.report(Outcome(name, 125, 0.0, log + output))

    def report_unclaimed(self, output: str) -> None:
        for test in self.unclaimed():
            (self.queue / test.name).mkdir(exist_ok=True)
            self.reported.add(test.name)
            self.report(Outcome(test.name, 125, 0.0, output))


def call(command: list, while_waiting: Callable[[], None] = lambda: None) -> tuple[int, str]:
    """Runs a command. Returns its exit status and output."""
    with tempfile.TemporaryFile("w+", errors="replace") as output:
        child = subprocess.Popen(list(map(str, command)), env=environment(), stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
        CHILDREN.add(child)
        while child.poll() is None:
            time.sleep(POLL_S)
            while_waiting()
        CHILDREN.discard(child)
        output.seek(0)
        return child.returncode, output.read()


def stop_all() -> None:
    """Ends every kernel. with-vcan passes the signal on and cleans up."""
    for child in list(CHILDREN):
        child.send_signal(signal.SIGTERM)
    for child in list(CHILDREN):
        child.wait()


def run(tests: list[VcanTest], report: Report, jobs: int = JOBS) -> None:
    """Runs `tests`. When a test ends, calls `report` from the test's thread."""
    modules = set().union(*(test.modules for test in tests)) if tests else set()
    with tempfile.TemporaryDirectory(prefix="vcan-tests.") as folder:
        queue = Path(folder).resolve()
        this_run = Run(tests, queue, report, in_user_mode_kernel(modules))
        threads = [threading.Thread(target=this_run.job, args=(number == 0,)) for number in range(jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()


def set_environment() -> None:
    """For use by hand: finds the program, the measured data and the Python packages where tests/all puts them."""
    repository = HERE.parent.parent
    target = Path(os.environ.get("CARGO_TARGET_DIR", repository / "target"))
    data, venv = repository / "../shared/data", repository / "target/test-venv"
    os.environ.setdefault("PACKWATCH_BIN", str(target / "release/packwatch"))
    if data.is_dir():
        os.environ.setdefault("PACKWATCH_DATA", str(data.resolve()))
    if (venv / "bin/python3").exists():
        os.environ["PATH"] = f"{venv}/bin:{os.environ['PATH']}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", type=Path, metavar="TEST", help="files; default: all")
    parser.add_argument("--jobs", type=int, default=JOBS, help="number of kernels at a time [%(default)s]")
    parser.add_argument("--smoke", action="store_true", help="only the tests marked as smoke tests")
    options = parser.parse_args()
    paths = [path.resolve() for path in options.tests] or sorted(HERE.glob("*.test"))
    tests = [test for test in map(read_head, paths) if test.is_smoke or not options.smoke]
    set_environment()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: (stop_all(), os._exit(128 + number)))
    outcomes, lock = [], threading.Lock()

    def report(outcome: Outcome) -> None:
        with lock:
            outcomes.append(outcome)
            verdict = {0: "passed", SKIPPED: "SKIPPED"}.get(outcome.status, f"FAILED, status {outcome.status}")
            print(f"==> {outcome.name}\n{outcome.output}    {verdict}, {outcome.seconds:.0f} s", flush=True)

    started = time.monotonic()
    run(tests, report, options.jobs)
    failed = sorted(outcome.name for outcome in outcomes if outcome.status not in (0, SKIPPED))
    slowest = sorted(outcomes, key=lambda outcome: -outcome.seconds)
    print(f"==> {time.monotonic() - started:.0f} s, slowest first: " + ", ".join(f"{o.name} {o.seconds:.0f}" for o in slowest))
    print(f"{len(outcomes)} tests, {len(failed)} failed" + (": " + " ".join(failed) if failed else ""))
    return 1 if failed or len(outcomes) < len(tests) else 0


if __name__ == "__main__":
    sys.exit(main())
