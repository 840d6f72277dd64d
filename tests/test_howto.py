"""The short pages for those who come after run as they stand, and say what they assert."""

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HOWTO = ROOT / "docs" / "howto"


def code_of(page: str) -> str:
    """All Python of a page, in its order."""
    text = (HOWTO / f"{page}.md").read_text()
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


def files_of(page: str) -> dict[str, str]:
    """Files that a page says are there, by name."""
    text = (HOWTO / f"{page}.md").read_text()
    return dict(re.findall(r"```(?:python|toml) (\S+)\n(.*?)```", text, re.DOTALL))


@pytest.mark.parametrize("page", ["add_a_sensor", "add_a_filter", "a_filter_of_your_own"])
def test_the_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in files_of(page).items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(sys, "path", [*sys.path])
    try:
        exec(compile(code_of(page), f"{page}.md", "exec"), {"__name__": page})
    finally:
        for name in files_of(page):
            sys.modules.pop(Path(name).stem, None)


def test_a_filter_of_your_own_is_short():
    """Filter, truth, wiring and verdict: under 60 lines that are not empty."""
    page = "a_filter_of_your_own"
    verdict = code_of(page).partition("class Strays")[0]
    lines = [*files_of(page).values(), verdict]
    assert sum(1 for text in lines for line in text.splitlines() if line.strip()) < 60


def test_a_file_format_is_found_by_its_suffix(tmp_path):
    """The reader of the page, registered as the page says, serves the command line."""
    package = tmp_path / "mypackage"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "tables.py").write_text(code_of("add_a_file_format"))
    text = (HOWTO / "add_a_file_format.md").read_text()
    group, entry = re.search(r'entry-points\."(.*?)"\]\n(.*?)\n', text).groups()
    info = tmp_path / "mypackage-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mypackage\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entry.replace(chr(34), '')}\n")
    table = """\
        orbit, orbit, r0_i=[7070;0;0] km, v0_i=[0;0;7.51] km/s
        attitude, lvlh_attitude
        orbit.r_e -> attitude.r_e
        orbit.v_e -> attitude.v_e
        orbit.delta_v_e -> attitude.delta_v_e
        """.replace(";", ", ")
    table = re.sub(r"(\w+=\[.*?\] [\w/]+)", r'"\1"', textwrap.dedent(table))
    (tmp_path / "table.csv").write_text(table.replace(', "', ',"'))
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from terrafix.cli import main; main()"
    )
    command = [sys.executable, "-c", code, "check"]
    done = subprocess.run(
        [*command, str(tmp_path / "table.csv")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "table: 2 components in stepping order, 3 connections" in done.stdout
    wrong = subprocess.run(
        [*command, str(tmp_path / "table.xls")], capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 2
    assert ".csv" in wrong.stderr


def test_the_map_names_every_folder():
    """docs/architecture.md describes the folders that are there, and no others."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"^\| `([\w/]+)` \|", page, re.MULTILINE))
    there = {
        str(p.parent.relative_to(ROOT))
        for wing in ("models", "cosim", "components", "src/terrafix")
        for p in (ROOT / wing).rglob("__init__.py")
    }
    inner = {f for f in there if f.startswith("cosim/exchange/")}
    tops = {"models", "cosim", "components", "src/terrafix"}
    assert named == there - inner - tops
    for folder in inner:
        assert (
            folder.rpartition("exchange/")[2] in page.replace("`fmi/write`, `fmi/run`", "")
            or folder in page
            or folder.split("exchange/")[1] in page
        )
