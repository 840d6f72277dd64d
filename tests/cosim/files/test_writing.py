"""What is written reads back as the same system, and looks as if a person had written it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import terrafix as tf
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.files.writing import system_text, write_system
from terrafix.cosim.system.system import System

FILE = """\
schema = "terrafix-system/1"
name = "pair"
doc = "two\\nlines, a \\"quote\\" and a \\\\"
duration = "10 s"
members = 3
seed = 7

[component.a]
type = "linear"
doc = "what it is for, # and all"
period = "1/30 s"
offset = "1/60 s"
factor = "2"
shift = "0"
width = 1
flat = true
unit_in = "1"
unit_out = "1"

[component.b]
type = "linear"
times = ["1", "2.5"]
factor = "1"
shift = "0"
width = 1
flat = true
unit_in = "1"
unit_out = "1"

[component.c]
type = "linear"
period = "1 s"
factor = "1"
shift = "0"
width = 1
flat = true
unit_in = "1"
unit_out = "1"

[wiring]
connect = [
    "c.y -> a.x",
    "a.y -> c.x (delay 1/30 s)",
]

[expose]
open = "b.x"
result = "b.y"

[record.out]
doc = "to look at"
ports = ["a.y", "b.y"]
period = "1 s"
offset = "0.5 s"
"""


def test_what_is_read_is_written_as_it_was(tmp_path):
    file, again = tmp_path / "pair.toml", tmp_path / "again.toml"
    file.write_text(FILE)
    write_system(read_system(file, outside=True), again)
    assert again.read_text() == FILE


def test_a_relative_file_is_the_same_from_any_folder(tmp_path, monkeypatch):
    """As it was given in Python, beside the folder that was the current one then."""
    monkeypatch.chdir(tmp_path)
    with System("relative", duration=1) as system:
        system.add(tf.components.terrain(source="file", dem_file="N00E000.hgt"), "terrain")
    text = system_text(system)
    assert f'dem_file = "{tmp_path / "N00E000.hgt"}"' in text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("texts")


@given(text=st.text(st.characters(exclude_categories=["Cs"])), count=st.integers(1, 2**62))
@settings(max_examples=20, deadline=None)
def test_any_text_reads_back(folder, text, count):
    file = folder / "system.toml"
    file.write_text(FILE)
    system = read_system(file, outside=True)
    system.doc, system.seed = text, count
    write_system(system, file)
    again = read_system(file, outside=True)
    assert (again.doc, again.seed) == (text, count)
    assert system_text(again) == system_text(system)


class Unregistered(Component):
    default_rate = None


def test_what_cannot_be_written_is_refused_and_nothing_is_written(tmp_path):
    system = System("own")
    system.add(Unregistered(), "part")
    file = tmp_path / "own.toml"
    file.write_text("kept")
    with pytest.raises(ConfigurationError, match="'part' is a Unregistered, which is no regist"):
        write_system(system, file)
    assert file.read_text() == "kept"
    with pytest.raises(ConfigurationError, match=r"cannot write '.*own\.toml': No such file"):
        write_system(System("empty"), tmp_path / "gone" / "own.toml")
