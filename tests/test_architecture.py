"""Layers hold: imports point one way, the core knows no navigation, imports stay light."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WINGS = {
    "models": "models",
    "cosim": "cosim",
    "components": "components",
    "terrafix": "src/terrafix",
}
"""Folder of each wing; the last holds the import name and the command line."""
ORDER = [
    *("models.core", "models.geometry", "models.motion", "models.motion.orbits"),
    *("models.maps", "models.sensors"),
    *("models.radar", "models.radar.recordings", "models.images", "models.filters", "models"),
    *("cosim.basics", "cosim.show", "cosim.memory", "cosim.declare", "cosim.kernels"),
    *("cosim.system", "cosim.files", "cosim.records", "cosim.engine", "cosim.lincov"),
    *("cosim.campaign.statistics", "cosim.campaign", "cosim.report"),
    *("cosim.exchange.fmi.run", "cosim.exchange.fmi.write", "cosim.exchange.fmi.check"),
    *("cosim.exchange.fmi", "cosim.exchange.ssp", "cosim.exchange", "cosim"),
    *("components", "components.truth", "components.sensors", "components.images"),
    *("components.filters", "components.judges"),
    *("terrafix.cli", "terrafix"),
]
"""Every folder, from the bottom up: each imports only from those before it."""
FORBIDDEN = {("cosim", "models")}
"""Wings that do not know each other, though the order would allow it."""
MODULES = sorted((wing, path) for wing, at in WINGS.items() for path in (ROOT / at).rglob("*.py"))
NAVIGATION = {
    *("aircraft", "altitude", "antenna", "attitude", "azimuth", "boresight", "camera", "doppler"),
    *("earth", "ecef", "ellipsoid", "gyro", "gyroscope", "imu", "inertial", "kalman", "landmark"),
    *("latitude", "longitude", "lvlh", "mekf", "navigation", "orbit", "quaternion", "radar"),
    *("sar", "satellite", "spacecraft", "terrain", "velocity"),
}
LATE = (
    "casadi scipy xarray pint matplotlib netCDF4 rich cv2 fmpy "
    "psutil filelock platformdirs tomlkit jinja2 shapely contourpy "
    "erfa sgp4 pymsis brahe astropy_iers_data rasterio pyproj sarkit"
)
HEAVY = {
    "terrafix": f"numpy click {LATE}",
    "terrafix.cosim.system.system": LATE,
    "terrafix.cosim.engine.run": LATE,
    "terrafix.cosim.files.reading": LATE,
    "terrafix.cosim.files.readers": LATE,
    "terrafix.cli": f"numpy {LATE}",
}


def names(values):
    return [f"{layer}/{path.name}" for layer, path in values]


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imported(path: Path) -> set[str]:
    """Every module named in an import statement, at whatever depth."""
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def dotted(wing: str, path: Path) -> str:
    """Import name of a module without "terrafix.", the wing first."""
    parts = path.relative_to(ROOT / WINGS[wing]).with_suffix("").parts
    return ".".join([wing, *(part for part in parts if part != "__init__")])


NAMED = {dotted(wing, path): path for wing, path in MODULES}


def room_of(module: str) -> str:
    """The folder a module of ours lies in."""
    return module if NAMED[module].name == "__init__.py" else module.rpartition(".")[0]


def reached(path: Path) -> set[str]:
    """Modules of ours that a file imports, or imports something from."""
    found = set()
    for name in imported(path):
        parts = name.split(".")
        if parts[0] != "terrafix":
            continue
        parts = parts[1:] if len(parts) > 1 and parts[1] in WINGS else parts
        while parts and ".".join(parts) not in NAMED:
            parts.pop()
        found.add(".".join(parts) or "terrafix")
    return found


def test_the_order_names_every_folder():
    assert sorted(ORDER) == sorted({room_of(module) for module in NAMED})


@pytest.mark.parametrize("module", NAMED)
def test_imports_between_folders_run_one_way(module):
    own = room_of(module)
    for other in reached(NAMED[module]):
        room = room_of(other)
        assert room == own or ORDER.index(room) < ORDER.index(own), f"{module} climbs to {other}"
        assert (own.split(".")[0], room.split(".")[0]) not in FORBIDDEN


def test_imports_within_folders_have_no_circles():
    graph = {
        module: {o for o in reached(path) if room_of(o) == room_of(module)} - {module}
        for module, path in NAMED.items()
    }
    list(TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


FOREIGN = {
    "os._exit": "the system's own name for leaving without clean-up",
    "drawn._repr_png_": "Jupyter's own name, given to a figure of matplotlib",
}
"""Underscore names of others that are used, and why."""


@cache
def touched(path: Path) -> set[str]:
    """Underscore names that a module uses though it did not define them."""
    tree = tree_of(path)
    own, used = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            own.add(node.id)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("terrafix"):
            used |= {f"{node.module}.{a.name}" for a in node.names if a.name.startswith("_")}
        elif isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            if ast.unparse(node.value) in ("self", "cls", "super()"):
                own |= {node.attr} if isinstance(node.ctx, ast.Store) else set()
            elif not node.attr.startswith("__"):
                used.add(ast.unparse(node))
    return {name for name in used if name.rpartition(".")[2] not in own}


@pytest.mark.parametrize("module", NAMED)
def test_no_module_touches_anothers_underscore_names(module):
    assert touched(NAMED[module]) <= set(FOREIGN)


def test_the_walk_sees_underscore_names(tmp_path):
    """And every exception is needed."""
    file = tmp_path / "module.py"
    file.write_text("class A:\n  def f(self, b):\n    self._x = b._y\n    return b._x\n")
    assert touched(file) == {"b._y"}
    assert {name for path in NAMED.values() for name in touched(path)} == set(FOREIGN)


def test_the_walk_sees_imports():
    """The tests above could fail: what is imported is found, inside functions too."""
    assert "cosim.records.results" in reached(NAMED["components.truth.playback"])
    assert room_of("models.sensors.sar") == "models.sensors"
    assert "terrafix.cli" in reached(NAMED["terrafix.__main__"])


@pytest.mark.parametrize("room", ORDER)
def test_every_folder_says_in_one_sentence_what_belongs_in_it(room):
    doc = ast.get_docstring(tree_of(NAMED[room]))
    first = doc.split("\n\n")[0]
    assert first.endswith(".")
    assert ". " not in first


def test_tests_lie_in_the_folders_of_what_they_test():
    """Each folder of tests is a folder of the house; systems and examples are tested whole."""
    folders = {p.parent.relative_to(ROOT / "tests") for p in (ROOT / "tests").rglob("test_*.py")}
    rooms = {*(Path(*room.removeprefix("terrafix.").split(".")) for room in ORDER), Path()}
    assert folders - rooms == {Path("systems"), Path("examples")}


@pytest.mark.parametrize(("layer", "path"), MODULES, ids=names(MODULES))
def test_modules_and_what_is_public_in_them_have_docstrings(layer, path):
    tree = tree_of(path)
    assert ast.get_docstring(tree), f"{path} has no docstring"
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{path}: {node.name} has no docstring"


# ------------------------------------------------------------------------- no navigation in cosim

CORE = [path for layer, path in MODULES if layer == "cosim"]


def vocabulary(path: Path) -> set[str]:
    """Words of identifiers and of texts in the code; docstrings may show examples."""
    tree = tree_of(path)
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
    assert {"orbit", "earth", "velocity"} <= vocabulary(ROOT / "components" / "truth" / "orbit.py")
    assert {"sar", "antenna", "boresight"} <= vocabulary(ROOT / "components" / "sensors" / "sar.py")


# ------------------------------------------------------------------------- quick to import


@pytest.mark.parametrize("module", HEAVY)
def test_importing_brings_nothing_heavy(module):
    """What is needed late is imported late: commands must answer at once."""
    code = f"import sys, {module}; print(*(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(done.stdout.split()) & set(HEAVY[module].split())
