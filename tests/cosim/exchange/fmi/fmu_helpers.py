"""Helpers of the tests of FMUs and packages."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from terrafix.cosim.exchange.fmi.run.platforms import host_platform
from terrafix.cosim.exchange.fmi.write.binaries import build

EXAMPLES = Path(__file__).parents[4] / "examples"
OPEN_LOOP = EXAMPLES / "spacecraft_sar_open_loop.toml"


def without_evaluation(path, name="open_loop"):
    """The open loop as a file whose components are all symbolic."""
    text = OPEN_LOOP.read_text()
    text = re.sub(r"\[component.evaluation\].*?\n\n", "", text, flags=re.DOTALL)
    text = re.sub(r'    "[^"]*evaluation[^"]*",\n', "", text)
    text = text.replace('name = "spacecraft_sar_open_loop"', f'name = "{name}"')
    text += '\n[expose]\nr_e = "orbit.r_e"\nestimate = "correct.estimate"\n'
    text += 'innovation = "correct.innovation"\nprior = "predict.prior"\n'
    path.write_text(text)
    return path


def broken(source, target, patches=(), xml=()):
    """Copy an FMU with its C patched and compiled again, and its description patched."""
    with zipfile.ZipFile(source) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    sources = {
        Path(n).name: d.decode()
        for n, d in content.items()
        if n.startswith("sources/") and n.endswith((".c", ".h"))
    }
    for file, old, new in patches:
        assert old in sources[file], (file, old)
        sources[file] = sources[file].replace(old, new)
    if patches:
        compiled = [n for n in sources if n.endswith(".c") and n != "noise.c"]
        library = build(sources, compiled, (None,))[host_platform()]
        name = next(n for n in content if n.startswith("binaries/"))
        content[name] = library
    for old, new in xml:
        text = content["modelDescription.xml"].decode()
        assert old in text, old
        content["modelDescription.xml"] = text.replace(old, new).encode()
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return target


def has_zig():
    return importlib.util.find_spec("ziglang") is not None


def in_another_process(tool, code, *arguments):
    if importlib.util.find_spec(tool) is None:
        pytest.skip(f"{tool} is not installed")
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    lines = [x for x in done.stdout.splitlines() if x.startswith("RESULT")]
    if not lines and "cannot open shared object" in done.stderr:
        pytest.skip(f"{tool} cannot be loaded: {done.stderr.strip().splitlines()[-1]}")
    assert lines, done.stderr[-800:]
    return json.loads(lines[0].removeprefix("RESULT"))


ECOS = """
import json, sys
from ecospy import EcosSimulation
with EcosSimulation(step_size=0.01, ssp_path=sys.argv[1]) as simulation:
    simulation.init(0.0)
    simulation.step(int(sys.argv[2]))
    print("RESULT", json.dumps([simulation.get_real(n) for n in sys.argv[3:]]))
"""
