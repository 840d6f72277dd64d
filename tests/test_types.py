"""What a user looks at says what it is: no `Any` in signatures but where nobody can know better."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOOKED_AT = {
    "cosim/basics/clock.py": {"Rate"},
    "cosim/declare/component.py": {"Component", "PortRef"},
    "cosim/declare/parameters.py": None,
    "cosim/declare/ports.py": None,
    "cosim/engine/result.py": None,
    "cosim/engine/run.py": {"simulate", "RunError"},
    "cosim/engine/simulation.py": {"Simulation"},
    "cosim/memory/fields.py": {"Field"},
    "cosim/system/check.py": {"Plan"},
    "cosim/system/graph.py": {"Diagram"},
    "cosim/system/system.py": {"System"},
}
"""Classes and functions by module; None for all that are public."""
UNKNOWN = {
    # a setting by name has the type of whatever has that name; component.sigma is typed
    "Component.setting",
    # what get_state gave, for set_state alone
    *("Component.get_state", "Component.set_state", "Simulation.get_state"),
    *("Simulation.set_state", "Simulation.check_identity"),
    # nested content of JSON and TOML
    *("Result.evaluation", "Result.summary", "Simulation.attributes", "Simulation.evaluate"),
    *("Plan.content", "Table.read", "FileTable.read"),
    # what `read` gave, and TOML of it
    *("Setting.write", "Parameter.write"),
}


def anys(annotation):
    """Whether an annotation names Any; an array of any dtype is said to be just that."""
    if annotation is None:
        return False
    if isinstance(annotation, ast.Subscript) and ast.unparse(annotation.value) == "NDArray":
        return False
    if isinstance(annotation, ast.Name):
        return annotation.id == "Any"
    return any(anys(child) for child in ast.iter_child_nodes(annotation))


def annotations(node, name):
    """Pairs of a name and an annotation in a public function or class."""
    if isinstance(node, ast.ClassDef):
        for each in node.body:
            inner = getattr(each, "name", "")
            if isinstance(each, ast.AnnAssign):
                yield f"{name}.{ast.unparse(each.target)}", each.annotation
            elif (isinstance(each, ast.FunctionDef) and not inner.startswith("_")) or inner in (
                "__init__",
                "__getitem__",
                "__get__",
                "__set__",
            ):
                yield from annotations(each, f"{name}.{inner}")
    elif isinstance(node, ast.FunctionDef):
        a = node.args
        given = [*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg]
        for argument in filter(None, given):
            yield name, argument.annotation
        yield name, node.returns


def looked_at(path, chosen):
    for node in ast.parse((ROOT / path).read_text()).body:
        name = getattr(node, "name", "_")
        if not name.startswith("_") and (chosen is None or name in chosen):
            yield from annotations(node, name)


@pytest.mark.parametrize("path", LOOKED_AT)
def test_signatures_name_types(path):
    vague = {name for name, found in looked_at(path, LOOKED_AT[path]) if anys(found)}
    assert not vague - UNKNOWN


def test_every_exception_is_one():
    found = [pair for path, chosen in LOOKED_AT.items() for pair in looked_at(path, chosen)]
    assert {name for name, annotation in found if anys(annotation)} == UNKNOWN
    assert len(found) > 150
