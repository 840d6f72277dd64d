"""Whether verdicts on a filter of one's own are right: false alarms, and faults that are found.

    python benchmarks/verdicts.py [--campaigns 200] [--runs 50]

The filter is that of ``docs/howto/a_filter_of_your_own.md``, read from the page: two states, one
measured element, 100 s. Flown as it is, with a quarter of its process noise, and with a sensor that
reports twice the variance that it has.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import terrafix as tf

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "a_filter_of_your_own.md"


def files() -> Path:
    """The files of the page, in a folder of their own."""
    folder = Path(tempfile.mkdtemp())
    for name, text in re.findall(
        r"```(?:python|toml) (\S+)\n(.*?)```", PAGE.read_text(), re.DOTALL
    ):
        (folder / name).write_text(text)
    return folder


def doubtful(folder: Path) -> type[tf.Component]:
    """A sensor that reports twice the variance that it has."""
    from dataclasses import replace

    sys.path.insert(0, str(folder))
    import tracker

    class Look(tracker.Look):  # type: ignore[misc,name-defined]
        """Reports twice the variance."""

        def build_model(self) -> tf.Model:
            model = super().build_model()
            return replace(model, outputs={**model.outputs, "fix.R": 2 * model.outputs["fix.R"]})

    return Look


def main() -> None:
    """Fly the campaigns, and count what they were called."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--runs", type=int, default=50)
    options = parser.parse_args()
    folder = files()
    for case in ("sound", "Q / 4", "R x 2"):
        system = tf.read_system(folder / "line.toml")
        if case == "Q / 4":
            system.find("predict").psd = "0.0025 m^2/s^3"
        if case == "R x 2":
            system.replace("look", doubtful(folder)(sigma="5 m"))
        words: Counter[str] = Counter()
        began = time.perf_counter()
        for seed in range(1, options.campaigns + 1):
            found = tf.run_campaign(system, runs=options.runs, seed=seed, workers=1)
            words[found.verdicts["judge"].text] += 1
        said = ", ".join(f"{word} {n}" for word, n in words.most_common())
        print(
            f"{case:6}  {options.campaigns} campaigns of {options.runs} runs: {said}  "
            f"({time.perf_counter() - began:.0f} s)"
        )


if __name__ == "__main__":
    main()
