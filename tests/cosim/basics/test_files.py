"""A file is refused before the work if it cannot be written, and whole or not there."""

import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.files import replacing, writable_target, write_atomically


def refusal(path, *arguments, **options):
    with pytest.raises(ConfigurationError) as caught:
        writable_target(path, *arguments, **options)
    return str(caught.value)


def test_what_can_be_written_is_returned_and_not_touched(tmp_path):
    file = tmp_path / "page.HTML"
    assert writable_target(str(file), (".html", ".htm")) == file
    assert not list(tmp_path.iterdir())
    file.write_text("kept")
    assert writable_target(file) == file
    assert file.read_text() == "kept"


def test_what_cannot_be_written_is_refused(tmp_path):
    assert refusal(tmp_path / "run.txt", (".nc",), reason="results are NetCDF: ") == (
        f"'{tmp_path}/run.txt' is no .nc file\n  results are NetCDF: name it 'run.nc'"
    )
    assert refusal(tmp_path / "run", (".png", ".svg"), option="--plot") == (
        f"--plot '{tmp_path}/run' is no .png or .svg file\n  name it 'run.png'"
    )
    assert refusal(tmp_path, (".nc",)) == f"'{tmp_path}' is a folder; name a file in it"
    assert refusal(".", (".nc",)) == "'.' is a folder; name a file in it"
    assert refusal("", (".nc",)) == "cannot write '': it names no file\n  name one"
    assert refusal(tmp_path / "a" / "b.nc", (".nc",), option="--out") == (
        f"cannot write --out '{tmp_path}/a/b.nc': there is no folder '{tmp_path}/a'"
    )
    assert refusal(tmp_path / f"{'n' * 300}.nc", (".nc",)).endswith(": File name too long")


def test_a_folder_that_is_read_only_is_said(tmp_path, monkeypatch):
    def refuse(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    assert refusal(tmp_path / "x") == f"cannot write '{tmp_path}/x': Permission denied"


def test_a_file_is_replaced_when_all_is_written(tmp_path):
    file = tmp_path / "state"
    write_atomically(file, lambda f: f.write(b"one"))

    def half(opened):
        opened.write(b"tw")
        assert file.read_bytes() == b"one"
        raise OSError(28, "No space left on device")

    with pytest.raises(ConfigurationError) as caught:
        write_atomically(file, half)
    assert str(caught.value) == (
        f"cannot write '{file}': No space left on device\n  choose another place, or make room"
    )
    assert [p.name for p in tmp_path.iterdir()] == ["state"]
    assert file.read_bytes() == b"one"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_other_errors_leave_nothing_behind_and_pass(tmp_path, error):
    def interrupted():
        with replacing(tmp_path / "state") as partial:
            partial.write_bytes(b"half")
            raise error

    with pytest.raises(error):
        interrupted()
    assert not list(tmp_path.iterdir())
