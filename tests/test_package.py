"""What is packaged is the whole house: the built wheel flies an example without the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEFTOVERS = shutil.ignore_patterns("__pycache__", "*.egg-info")


def build(folder):
    """Build from a copy: what earlier builds left in the checkout must not get into it."""
    source = folder / "source"
    for name in ("models", "cosim", "components", "src"):
        shutil.copytree(ROOT / name, source / name, ignore=LEFTOVERS)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "-w", str(folder)]
    subprocess.run([*command, str(source)], check=True, capture_output=True)
    (file,) = folder.glob("terrafix-*.whl")
    return file


def test_the_wheel_is_the_house_and_flies_an_example(tmp_path):
    """All of its files and nothing else; unpacked in front of the checkout, it runs."""
    with zipfile.ZipFile(build(tmp_path)) as archive:
        packed = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    wings = {
        "models": "terrafix/models",
        "cosim": "terrafix/cosim",
        "components": "terrafix/components",
        "src/terrafix": "terrafix",
    }
    kinds = {".py", ".c", ".h", ".j2", ".gfc", ".typed"}
    expected = {
        f"{name}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, name in wings.items()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in kinds or path.name == "py.typed"
    }
    assert {p for p in packed if p.startswith("terrafix/")} == expected
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r})\n"
        "sys.meta_path = [f for f in sys.meta_path if 'editable' not in str(f)]\n"
        "import terrafix.cosim.engine.run as run; print(run.__file__, file=sys.stderr)\n"
        "from terrafix.cli import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "run", str(ROOT / "examples" / "orbit.toml")],
        cwd=tmp_path,
        env=os.environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "site") in done.stderr
    assert "orbit: 1 member, 5,916 ticks" in done.stdout
