"""Checkpoints: one file with everything a run needs to continue to the same bytes.

Nested dicts, lists, numbers, texts and arrays; no code in it (no pickle). A checkpoint belongs to
a system, a seed and an ensemble, and says so.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.cosim.basics.errors import CheckpointError
from terrafix.cosim.basics.files import write_atomically

SCHEMA = "terrafix-checkpoint/1"


def _pack(value: Any, arrays: dict[str, Any]) -> Any:
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        key = f"a{len(arrays)}"
        arrays[key] = value
        return {"__array__": key}
    if isinstance(value, dict):
        return {str(k): _pack(v, arrays) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_pack(v, arrays) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    kind = f"{value.dtype} array" if isinstance(value, np.ndarray) else type(value).__name__
    raise CheckpointError(
        f"a state of type {kind} cannot be saved\n"
        "  give numbers, texts, lists, dicts and arrays of numbers"
    )


def _unpack(value: Any, arrays: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {"__array__"}:
            return arrays[value["__array__"]]
        return {k: _unpack(v, arrays) for k, v in value.items()}
    if isinstance(value, list):
        return [_unpack(v, arrays) for v in value]
    return value


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all."""
    arrays: dict[str, Any] = {}
    tree = _pack(content | {"schema": SCHEMA}, arrays)
    text = np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8)
    write_atomically(path, lambda f: np.savez(f, tree=text, **arrays))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint.

    Raises
    ------
    CheckpointError
        If the file is absent, damaged, no checkpoint, or of a schema this version cannot read.
    """
    if not path.is_file():
        raise CheckpointError(
            f"there is no checkpoint '{path}'\n  write one with --checkpoint-every SECONDS"
        )
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            tree = json.loads(bytes(stored["tree"]))
            arrays = {k: stored[k] for k in stored.files if k != "tree"}
    except Exception as error:  # a damaged file may fail in any way
        raise CheckpointError(
            f"'{path}' is damaged or no checkpoint\n  start the run again without --resume"
        ) from error
    schema = tree.get("schema") if isinstance(tree, dict) else None
    if schema != SCHEMA:
        raise CheckpointError(
            f"'{path}' has schema {schema!r}; this version reads {SCHEMA!r}\n"
            "  resume with the version of terrafix that wrote it"
        )
    content: dict[str, Any] = _unpack(tree, arrays)
    return content
