"""The FMUs of hand-written packages, built once."""

from __future__ import annotations

import pytest
from plain_fmus import V, plain_fmu


@pytest.fixture(scope="session")
def fmus(tmp_path_factory):
    """k: y = k + u, length in m, and what it holds. p and q as in `test_starting`."""
    folder = tmp_path_factory.mktemp("fmus")
    kinds = [V("on", "parameter", True, "Boolean"), V("mode", "parameter", 1, "Enumeration")]
    plain_fmu(
        folder / "k.fmu",
        [
            V("u", "input", 0.0),
            V("k", "parameter", 1.0),
            V("length", "parameter", 1.0, unit="m"),
            *kinds,
            V("word", "parameter", "no", "String"),
            V("echo", "output", kind="String"),
            V("y", "output", depends="u"),
            V("said", "output", kind="Integer"),
            V("far", "output", unit="m"),
            V("kept", "output", 4.0, initial="exact"),
            V("time", "output"),
        ],
        begin="time = t;",
        outputs="y = k + u; said = 10 * mode + on + 100 * (int)strlen(word); far = length;",
        step="time = t + h;",
    )
    plain_fmu(folder / "p.fmu", [V("x", "output", 1.0, depends="")], step="x = 1.0 + t + h;")
    plain_fmu(
        folder / "q.fmu",
        [V("u", "input", 0.0), V("y", "output", depends="u"), V("s", "local")],
        begin="s = u;",
        outputs="y = s;",
        step="s += h * u;",
    )
    return {n: (folder / f"{n}.fmu").read_bytes() for n in "kpq"}
