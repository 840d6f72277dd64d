"""A file that need not be named: None, or a path beginning at the system file."""

from pathlib import Path

import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import OptionalFilePath


class Drawer(Component):
    """Draws to a file, if there is one."""

    picture = OptionalFilePath(doc="where to")


def test_unset_is_none_and_is_not_written():
    assert Drawer().setting("picture") is None
    setting = Drawer.settings()["picture"]
    assert not setting.required
    assert setting.write(None) is None
    assert setting.read(None, where="x") is None


def test_a_path_is_read_as_any_other(monkeypatch):
    monkeypatch.setenv("PLACE", "/data")
    assert Drawer(picture="${PLACE}/a.png").setting("picture") == Path("/data/a.png")
    assert Drawer.settings()["picture"].write(Path("/data/a.png")) == "/data/a.png"


def test_what_is_no_path_is_refused():
    with pytest.raises(ConfigurationError, match="'picture' is 3; it takes the path of a file"):
        Drawer(picture=3)
