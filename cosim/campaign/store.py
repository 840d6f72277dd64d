"""A campaign's folder: what it is, the blocks that are done, the result.

    campaign.json        system, seed, runs, configuration, versions
    blocks/000000.npz    of members 0 to 63: sums, dispersed parameters, failures, and of each its
                         last error and mean NEES and NIS; and so on
    histories/000000.nc  their full records, where these were asked for
    result.nc            the statistics of all
    summary.json         the same for people and programs, with the verdict

Each file is written whole or not at all, so a campaign killed at any moment can be resumed.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.campaign.batch import BlockResult
from terrafix.cosim.records.places import locked, unlock
from terrafix.cosim.system.identity import first_difference

if TYPE_CHECKING:
    from filelock import BaseFileLock

SCHEMA = "terrafix-campaign/2"
MANIFEST = "campaign.json"
RESULT = "result.nc"
SUMMARY = "summary.json"
_NUMBERED = "[0-9][0-9][0-9][0-9][0-9][0-9].npz"


class Store:
    """The folder of one campaign, for this process alone.

    Parameters
    ----------
    folder : Path
    identity : dict
        Plain types that say what the campaign is; another one in the folder is refused.
    resume : bool
        Continue what is there.

    Raises
    ------
    ConfigurationError
        If the folder cannot be written, holds something else, or is in use.
    CheckpointError
        If it holds another campaign, or none to resume; the difference is named.
    """

    def __init__(self, folder: Path, identity: dict[str, Any], *, resume: bool) -> None:
        self.folder = folder
        self._lock: BaseFileLock | None = None
        self._blocks = folder / "blocks"
        if folder.exists() and not folder.is_dir():
            raise ConfigurationError(f"'{folder}' is a file; a campaign needs a folder")
        known = (folder / MANIFEST).is_file()
        if resume and not known:
            raise CheckpointError(
                f"there is no campaign in '{folder}' to resume\n  start it without --resume"
            )
        if known and not resume:
            raise ConfigurationError(
                f"'{folder}' holds a campaign already\n"
                "  continue it with --resume, or give another --out"
            )
        if not known and folder.is_dir() and any(folder.iterdir()):
            raise ConfigurationError(
                f"'{folder}' is not empty and holds no campaign\n  give another --out"
            )
        try:
            self._blocks.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"cannot make the folder '{folder}': {error.strerror or error}"
            ) from error
        self._lock = locked(folder)
        try:
            if known:
                self._check(identity)
            else:
                text = json.dumps(identity | {"schema": SCHEMA}, indent=1)
                write_atomically(folder / MANIFEST, lambda f: f.write(text.encode()))
        except BaseException:
            self.close()
            raise

    def _check(self, identity: dict[str, Any]) -> None:
        theirs = read_manifest(self.folder)
        for key, mine in identity.items():
            other = theirs.get(key)
            if other == mine:
                continue
            if key == "configuration":
                raise CheckpointError(
                    f"'{self.folder}' holds a campaign of another configuration\n"
                    f"  {_shown(first_difference(mine, other))}"
                )
            if key == "versions":
                changed = [k for k in mine if mine[k] != (other or {}).get(k)]
                listed = ", ".join(f"{k} {(other or {}).get(k)}, here {mine[k]}" for k in changed)
                raise CheckpointError(
                    f"'{self.folder}' was begun with other versions: {listed}\n"
                    "  its bytes could not be completed; resume with those, or start anew"
                )
            raise CheckpointError(
                f"'{self.folder}' holds a campaign of another {key}: {other!r} there, {mine!r} "
                "here\n  give another --out, or what it was begun with"
            )

    def forget(self) -> None:
        """Remove what was begun, nothing having been flown."""
        if not self.done():
            (self.folder / MANIFEST).unlink(missing_ok=True)
            for each in (self._blocks, self.folder):
                with suppress(OSError):
                    each.rmdir()

    def close(self) -> None:
        """Give the folder back."""
        if self._lock is not None:
            unlock(self._lock)
            self._lock = None

    # ------------------------------------------------------------------ blocks

    def done(self) -> set[int]:
        """Numbers of the blocks that are there."""
        return {int(file.stem) for file in self._blocks.glob(_NUMBERED)}

    def write(self, block: BlockResult) -> None:
        """Keep a block."""
        arrays: dict[str, Any] = {}
        for path, sums in block.sums.items():
            arrays |= {f"{path}/{name}": value for name, value in sums.items()}
        arrays |= {f"parameter/{name}": value for name, value in block.parameters.items()}
        about = {"excluded": block.excluded, "kernel": block.kernel, "paths": list(block.sums)}
        text = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
        target = self._blocks / f"{block.number:06d}.npz"
        write_atomically(target, lambda f: np.savez_compressed(f, about=text, **arrays))

    def read(self, number: int) -> BlockResult | None:
        """Read a block; None, and the file removed, if it is damaged."""
        file = self._blocks / f"{number:06d}.npz"
        try:
            with file.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
                about = json.loads(bytes(stored["about"]))
                sums: dict[str, Any] = {path: {} for path in about["paths"]}
                parameters = {}
                for key in stored.files:
                    head, _, name = key.rpartition("/")
                    if head == "parameter":
                        parameters[name] = stored[key]
                    elif head in sums:
                        sums[head][name] = stored[key]
            return BlockResult(number, sums, parameters, about["excluded"], about["kernel"])
        except Exception:  # a damaged file may fail in any way
            file.unlink(missing_ok=True)
            return None


def read_manifest(folder: Path) -> dict[str, Any]:
    """What a campaign's folder says of itself.

    Raises
    ------
    CheckpointError
        If there is none, or it is damaged or of another schema.
    """
    try:
        content = json.loads((folder / MANIFEST).read_text())
    except FileNotFoundError:
        raise CheckpointError(
            f"there is no campaign in '{folder}'\n  give the folder that --out named"
        ) from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{folder / MANIFEST}' is damaged: {error}") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise CheckpointError(
            f"'{folder}' has schema {schema!r}; this version reads {SCHEMA!r}\n"
            "  use the version of terrafix that wrote it"
        )
    found: dict[str, Any] = content
    return found


def _shown(found: tuple[str, str | None, Any, Any] | None) -> str:
    if found is None:
        return "it differs"
    part, name, there, here = found
    return f"its {part} differ" if name is None else f"{part} '{name}': {there} there, {here} here"
