"""What stays of a run, a campaign and a check of FMUs that are killed at any moment?

    python benchmarks/fmu_kills.py [--times 30] [--seed 1] [--longest 8]

The open loop flies with its orbit in a process of its own (``isolate``), with a process for each
member, and as a campaign of two workers; `check-fmu` calls the same file. Each is killed after a
random time, by SIGTERM and SIGKILL in turn, and what is there 10 s later of processes and temporary
files is counted. All of them have a TMPDIR of their own, by which they are found.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from pathlib import Path

import psutil

import terrafix as tf

OPEN_LOOP = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"
PATIENCE = 10.0
"""How long something may stay [s]."""


def prepared(folder: Path) -> dict[str, list[str]]:
    """Write the FMUs and systems; the command lines to kill."""
    orbit, once = folder / "orbit.fmu", folder / "once.fmu"
    tf.export_fmu(tf.read_system(OPEN_LOOP), orbit, component="orbit", fmi=2)
    with zipfile.ZipFile(orbit) as source, zipfile.ZipFile(once, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "modelDescription.xml":
                flag = b'<CoSimulation canBeInstantiatedOnlyOncePerProcess="true" '
                data = data.replace(b"<CoSimulation ", flag)
            target.writestr(name, data)
    isolated = system(folder / "isolated.toml", orbit, "isolate = true")
    apart = system(folder / "apart.toml", once, "")
    long = ["--duration", "1000000", "--quiet"]
    return {
        "run, isolated": ["run", str(isolated), "--members", "4", *long],
        "run, a process a member": ["run", str(apart), "--members", "4", *long],
        "campaign, two workers": [
            "campaign", str(isolated), "--runs", "100", "--workers", "2", "--duration", "600",
            "--quiet", "--out", str(folder / "campaign"),
        ],
        "check-fmu": ["check-fmu", str(orbit)],
    }  # fmt: skip


def system(path: Path, fmu: Path, options: str) -> Path:
    """The open loop with its orbit from an FMU, as a file."""
    text = f'[component.orbit]\ntype = "fmu"\nfile = "{fmu}"\nrate = "100 Hz"\n{options}\n\n'
    whole = OPEN_LOOP.read_text()
    path.write_text(re.sub(r"\[component\.orbit\].*?\n(?=\[)", text, whole, flags=re.DOTALL))
    return path


def left(temporary: Path) -> list[str]:
    """Processes and temporary files that are there now."""
    found = [str(path) for path in temporary.iterdir()]
    for process in psutil.process_iter():
        try:
            if process.environ().get("TMPDIR") == str(temporary):
                found.append(" ".join(process.cmdline()) or f"process {process.pid}")
        except psutil.Error:
            pass
    return found


def killed(words: list[str], temporary: Path, how: signal.Signals, after: float) -> int | None:
    """Start, kill, and return the exit status; None where it had ended before."""
    process = subprocess.Popen(
        [sys.executable, "-m", "terrafix", *words],
        env=os.environ | {"TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    time.sleep(after)
    ended = process.poll() is not None
    if not ended:
        process.send_signal(how)
    status = process.wait(timeout=60)
    return None if ended else status


def main() -> int:
    """Kill all of them, and count what stays."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest", type=float, default=8.0, help="latest kill [s]")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    stayed = 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, words in prepared(folder).items():
            statuses: Counter[int | None] = Counter()
            slowest = 0.0
            for k in range(options.times):
                temporary = folder / f"temporary_{k}"
                temporary.mkdir(exist_ok=True)
                how = signal.SIGKILL if k % 2 else signal.SIGTERM
                statuses[killed(words, temporary, how, chance.uniform(0, options.longest))] += 1
                begun = time.monotonic()
                while (found := left(temporary)) and time.monotonic() < begun + PATIENCE:
                    time.sleep(0.05)
                slowest = max(slowest, time.monotonic() - begun)
                for each in found:
                    print(f"{name}, {how.name}: {each} stayed")
                stayed += len(found)
            ended = statuses.pop(None, 0)
            counts = ", ".join(f"{n} with status {s}" for s, n in sorted(statuses.items()))
            print(
                f"{name}: killed {sum(statuses.values())} times ({counts}), {ended} had ended; "
                f"all was gone after {slowest:.1f} s at the latest",
                flush=True,
            )
    print(f"{stayed} processes and temporary files stayed")
    return 1 if stayed else 0


if __name__ == "__main__":
    sys.exit(main())
