"""What all tests share: objects of FMUs that the compiler made once, and a quiet collector."""

import gc
import re
import shutil
import tempfile
from hashlib import sha256
from pathlib import Path

import pytest

from terrafix.cosim.exchange.fmi.write import binaries

gc.disable()  # nothing of what collecting tests makes is garbage


def pytest_collection_finish():
    """Thousands of tests and their modules stay until the end: leave them to no collector."""
    gc.freeze()
    gc.enable()


def read_by_the_compiler(folder: Path, name: str, seen: dict[str, str]) -> dict[str, str]:
    """A source and what it includes of its folder, by name."""
    if name not in seen and (folder / name).exists():
        seen[name] = (folder / name).read_text(encoding="utf-8")
        for other in re.findall(r'^\s*#\s*include\s+"([^"]+)"', seen[name], re.MULTILINE):
            read_by_the_compiler(folder, other, seen)
    return seen


@pytest.fixture(scope="session")
def common_folder(tmp_path_factory):
    """A folder of this run of the tests, the same in all of its processes."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if base.name.startswith("popen-") else base) / "common"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session", autouse=True)
def objects_are_compiled_once(common_folder):
    """Tests export the same components again and again: the same C is compiled once."""
    compiler = binaries._compile

    def compiled(folder, name, flags, target, command):
        texts = read_by_the_compiler(folder, name, {})
        key = sha256(repr((texts, flags, target.name, command)).encode()).hexdigest()
        kept = common_folder / f"{key}.o"
        made = folder / binaries._object(name, target)
        if not kept.exists():
            compiler(folder, name, flags, target, command)
            with tempfile.NamedTemporaryFile(dir=common_folder, delete=False) as file:
                file.write(made.read_bytes())
            Path(file.name).replace(kept)
        shutil.copyfile(kept, made)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(binaries, "_compile", compiled)
        yield
