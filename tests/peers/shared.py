"""Helpers for run, scaling and profile, which compare packwatch with other programs (its peers): paths, the Python that
the peers need, tables, and the results in tests/speed.md."""
import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", REPOSITORY / "target"))
BINARY = Path(os.environ.get("PACKWATCH_BIN", TARGET / "release/packwatch"))
CONFIG = REPOSITORY / "config/example.toml"
VENV = REPOSITORY / "target/peers-venv"
SPEED = REPOSITORY / "tests/speed.md"
INSTALL = "tests/peers/run --install"


def install():
    """Installs the peers' Python packages into a separate folder."""
    subprocess.run([sys.executable, "-m", "venv", "--clear", str(VENV)], check=True)
    subprocess.run([str(VENV / "bin/python3"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-r",
                    str(HERE / "requirements.txt")], check=True)


def python(*modules):
    """Returns a Python interpreter that has the modules, or None. Tries the one from `--install` first, then
    PACKWATCH_PYTHON or, without this variable, the running one."""
    for interpreter in (VENV / "bin/python3", os.environ.get("PACKWATCH_PYTHON", sys.executable)):
        command = [str(interpreter), "-c", "import " + ", ".join(modules)]
        try:
            if subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode == 0:
                return str(interpreter)
        except FileNotFoundError:
            pass
    return None


def output(*command, **options):
    """Returns the standard output of a command. If the command fails, exits with its error output."""
    run = subprocess.run([str(part) for part in command], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
    if run.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}\nfailed, status {run.returncode}: {run.stderr.strip()[-2000:]}")
    return run.stdout


def simulate(log, *options, binary=BINARY, config=CONFIG):
    output(binary, "simulate", "-c", config, "-o", log, *options)


def machine():
    """Describes the machine, its compiler, the commit and the load of the machine."""
    info = Path("/proc/cpuinfo").read_text()
    name = re.search(r"model name\s*: (.*)", info)
    rustc = output("rustc", "--version", cwd=REPOSITORY).split()[1]
    commit = output("git", "rev-parse", "--short", "HEAD", cwd=REPOSITORY).strip()
    measured = ["Cargo.toml", "Cargo.lock", "src", "benches", "config"]
    if output("git", "status", "--porcelain", "--", *measured, cwd=REPOSITORY):
        commit += " and changes"
    return (f"{os.cpu_count()} x {name[1] if name else 'processor of unknown name'}, rustc {rustc}, commit {commit}, "
            f"load {os.getloadavg()[0]:.1f}")


def table(header, rows):
    """A Markdown table. All columns after the first contain numbers."""
    lines = [header, ["---"] + ["---:"] * (len(header) - 1)] + rows
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def publish(name, command, text):
    """Replaces the block with this name in tests/speed.md."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    block = f"{begin}`{command}` ({machine()})\n\n{text.strip()}\n{end}"
    before = SPEED.read_text()
    start, stop = before.find(begin), before.find(end)
    if start < 0 or stop < 0:
        sys.exit(f"{SPEED} has no block named {name}")
    SPEED.write_text(before[:start] + block + before[stop + len(end):])
