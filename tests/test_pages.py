"""README and docs say what is there: names, modules, files; the programs of the README run."""

import re
from importlib import import_module
from pathlib import Path

import pytest

import terrafix as tf

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python(?: \S+)?\n(.*?)```", page.read_text(), re.DOTALL)


@EVERY_PAGE
def test_names_of_the_face_are_there_and_imports_are_few(page):
    for block in blocks(page):
        for name in re.findall(r"\btf\.((?:components\.|filters\.|testing\.)?\w+)", block):
            owner, _, last = name.rpartition(".")
            assert hasattr(getattr(tf, owner) if owner else tf, last), name
        imports = re.findall(r"^\s*(?:import|from) .*", block, re.MULTILINE)
        assert len(imports) <= 3
        assert not any("terrafix." in line for line in imports), "a page uses the face"


@EVERY_PAGE
def test_modules_that_are_named_are_there(page):
    for name in set(
        re.findall(r"\bterrafix\.(?:cosim|models|components|cli)[\w.]*\w", page.read_text())
    ):
        if f'"{name}"' in page.read_text():
            continue  # an entry-point group
        module, _, last = name.rpartition(".")
        try:
            import_module(name)
        except ImportError:
            assert hasattr(import_module(module), last), name


@EVERY_PAGE
def test_files_that_are_named_are_there(page):
    text = page.read_text()
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / link).exists(), link
    for path in re.findall(
        r"`((?:models|cosim|components|examples|tests|docs|benchmarks)/[\w./]+)`", text
    ):
        assert (ROOT / path).exists(), path


def test_the_programs_of_the_readme_run(tmp_path, monkeypatch):
    """From import to a picture of the open loop in four lines."""
    first, *others = blocks(ROOT / "README.md")
    assert len([line for line in first.splitlines() if line.strip()]) <= 5
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in (first.replace("members=100", "members=2"), *others):
        exec(compile(block, "README.md", "exec"), names)
    assert (tmp_path / "errors.png").stat().st_size > 10_000
