"""Layers hold: imports point one way, the core knows no navigation, imports stay light."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = {
    "models": ROOT / "models",
    "cosim": ROOT / "cosim",
    "components": ROOT / "components",
    "cli": ROOT / "src" / "terrafix",
}
MODULES = sorted((layer, path) for layer, folder in LAYERS.items() for path in folder.rglob("*.py"))
MAY_IMPORT = {
    "models": {"models"},
    "cosim": {"cosim"},
    "components": {"models", "cosim", "components"},
    "cli": {"cosim", "components", "cli"},
}
NAVIGATION = {
    *("aircraft", "altitude", "antenna", "attitude", "azimuth", "boresight", "camera", "doppler"),
    *("earth", "ecef", "ellipsoid", "gyro", "gyroscope", "imu", "inertial", "kalman", "landmark"),
    *("latitude", "longitude", "lvlh", "mekf", "navigation", "orbit", "quaternion", "radar"),
    *("sar", "satellite", "spacecraft", "terrain", "velocity"),
}
HEAVY = {
    "terrafix": "numpy casadi scipy xarray pint matplotlib netCDF4 rich click cv2 fmpy",
    "terrafix.cosim.system": "casadi scipy xarray pint matplotlib netCDF4 rich cv2 fmpy",
    "terrafix.cosim.run": "casadi scipy xarray pint matplotlib netCDF4 rich cv2 fmpy",
    "terrafix.cosim.files": "casadi scipy xarray pint matplotlib netCDF4 rich cv2 fmpy",
    "terrafix.cli": "numpy casadi scipy xarray pint matplotlib netCDF4 rich cv2 fmpy",
}


def names(values):
    return [f"{layer}/{path.name}" for layer, path in values]


def imported(path: Path) -> set[str]:
    """Every module named in an import statement, at whatever depth."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def layer_of(module: str) -> str | None:
    """Layer of a module of ours; None for others."""
    parts = module.split(".")
    if parts[0] != "terrafix":
        return None
    return parts[1] if len(parts) > 1 and parts[1] in LAYERS else "cli"


@pytest.mark.parametrize(("layer", "path"), MODULES, ids=names(MODULES))
def test_imports_point_one_way(layer, path):
    reached = {layer_of(m) for m in imported(path)} - {None}
    assert reached <= MAY_IMPORT[layer], f"{path} imports from {reached - MAY_IMPORT[layer]}"


def test_the_walk_sees_imports():
    """The test above could fail: it finds what is imported, inside functions too."""
    assert "terrafix.cosim.results.read_result" in imported(ROOT / "components" / "playback.py")
    assert layer_of("terrafix.models.sar") == "models"
    assert layer_of("terrafix.progress.ProgressBar") == "cli"


@pytest.mark.parametrize(("layer", "path"), MODULES, ids=names(MODULES))
def test_modules_and_what_is_public_in_them_have_docstrings(layer, path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree), f"{path} has no docstring"
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{path}: {node.name} has no docstring"


# ------------------------------------------------------------------------- no navigation in cosim

CORE = [path for layer, path in MODULES if layer == "cosim"]


def vocabulary(path: Path) -> set[str]:
    """Words of identifiers and of texts in the code; docstrings may show examples."""
    tree = ast.parse(path.read_text())
    shown = set()
    for node in ast.walk(tree):
        body = getattr(node, "body", [])
        for one in body if isinstance(body, list) else []:
            if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant):
                shown.add(one.value)
    said = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            said.append(node.id)
        elif isinstance(node, ast.Attribute):
            said.append(node.attr)
        elif isinstance(node, ast.arg | ast.keyword):
            said.append(node.arg or "")
        elif isinstance(node, ast.ClassDef | ast.FunctionDef):
            said.append(node.name)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in shown:
            said += _without_examples(node.value)
    split = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
    return {word.lower() for text in said for word in split.findall(text)}


def _without_examples(text: str) -> list[str]:
    """A text less what it quotes: "write "orbit.r_e -> attitude.r_e"" is advice, not knowledge."""
    return [re.sub(r'"[^"]*"|\'[^\']*\'|\[[^]]*\]', " ", text)]


@pytest.mark.parametrize("path", CORE, ids=lambda p: p.name)
def test_the_core_knows_no_navigation(path):
    assert not vocabulary(path) & NAVIGATION


def test_the_list_of_words_would_find_navigation():
    """The components are full of them; each of these must be seen."""
    assert {"orbit", "earth", "velocity"} <= vocabulary(ROOT / "components" / "orbit.py")
    assert {"sar", "antenna", "boresight"} <= vocabulary(ROOT / "components" / "sar.py")


# ------------------------------------------------------------------------- quick to import


@pytest.mark.parametrize("module", HEAVY)
def test_importing_brings_nothing_heavy(module):
    """What is needed late is imported late: commands must answer at once."""
    code = f"import sys, {module}; print(*(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(done.stdout.split()) & set(HEAVY[module].split())
