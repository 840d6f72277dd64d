"""The epoch of a system: text that the core hands on, and that components know."""

import datetime

import pytest
from click.testing import CliRunner

import terrafix as tf
from terrafix.cli import main
from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError, SystemCheckError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.files.writing import system_text
from terrafix.cosim.records.results import versions
from terrafix.cosim.system.system import System

NOON = "noon by the tower"


@pytest.fixture
def dated(toys):
    class Dated(toys.Clock):
        """Takes but one epoch, or none."""

        def validate_epoch(self, epoch):
            if epoch not in (None, NOON):
                raise ConfigurationError(f"'{self.name}' does not know {epoch!r}")

        def bind(self, environment):
            super().bind(environment)
            self.told = environment.epoch

    return Dated


def test_it_reaches_the_components_and_the_result(toys, dated):
    system = toys.wire({"c": dated()}, [], duration=3)
    for epoch in (None, NOON):
        system.epoch = epoch
        result = simulate(system)
        assert system.find("c").told == epoch
        assert result.dataset.attrs.get("epoch") == epoch
    assert f"epoch {NOON}" in repr(system)
    assert system.check().content()["epoch"] == NOON
    assert f"epoch {NOON}" in " ".join(repr(system.check()).split())


def test_with_a_date_the_versions_of_its_tables_are_kept():
    """They change with every package of tables; without a date nothing depends on them."""
    tables = {"pyerfa", "astropy-iers-data", "pymsis", "sgp4"}
    assert versions(NOON).keys() - versions().keys() == tables
    assert not versions().keys() & tables


def test_a_component_may_refuse_it(toys, dated):
    system = toys.wire({"c": dated()}, [], duration=3)
    system.epoch = "midnight"
    with pytest.raises(SystemCheckError, match="'c' does not know 'midnight'"):
        system.check()


def test_one_that_nobody_asks_for_is_refused(toys):
    system = toys.wire({"c": toys.Clock()}, [], duration=3)
    system.epoch = NOON
    with pytest.raises(SystemCheckError, match="'noon by the tower' does nothing: no component"):
        system.check()


@pytest.mark.parametrize(("outer", "fine"), [(NOON, True), (None, False), ("midnight", False)])
def test_a_system_within_has_no_other(toys, dated, outer, fine):
    inner = System("inner", epoch=NOON)
    inner.add(dated(), "c")
    system = System("outer", epoch=outer)
    system.add(inner, "inner")
    if fine:
        assert system.check().epoch == NOON
    else:
        with pytest.raises(
            SystemCheckError, match="'inner' has the epoch 'noon by the tower', and"
        ):
            system.check()


@pytest.mark.parametrize("epoch", ["", " ", 5, datetime.datetime(2022, 9, 18)])
def test_what_is_no_text_is_refused(epoch):
    with pytest.raises(ConfigurationError, match="it takes text with date, time and time scale"):
        System("s", epoch=epoch)


def test_a_component_asks_by_providing_the_method(toys, dated):
    assert dated.asks_for_epoch()
    assert not toys.Clock.asks_for_epoch()
    assert not Component.asks_for_epoch()


def test_a_checkpoint_belongs_to_its_epoch(toys, dated, tmp_path):
    system = toys.wire({"c": dated()}, [], duration=3)
    simulation = Simulation(system, duration=3)
    simulation.run_until(1)
    saved = simulation.get_state()
    simulation.master.terminate()
    system.epoch = NOON
    with pytest.raises(CheckpointError, match="made with other epoch"):
        Simulation(system, duration=3).set_state(saved)


FILE = f"""
schema = "terrafix-system/1"
name = "dated"
epoch = "{NOON}"
[component.c]
type = "dated_parts:Dated"
"""
PARTS = f"""
import terrafix as tf

class Dated(tf.Component):
    '''Takes one epoch.'''
    default_rate = tf.Rate("1")
    t = tf.Output(unit="s")

    def validate_epoch(self, epoch):
        if epoch != "{NOON}":
            raise tf.ConfigurationError(f"not {{epoch}}")

    def _step_impl(self, t, dt):
        self.t = t
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("dated")
    (tmp_path / "dated_parts.py").write_text(PARTS)
    path = tmp_path / "dated.toml"
    path.write_text(FILE)
    return path


def test_a_file_has_it_as_a_key_that_can_be_set(file):
    system = tf.read_system(file)
    assert system.epoch == NOON
    with pytest.raises(SystemCheckError, match="not midnight"):
        tf.read_system(file, [("epoch", "midnight")])
    assert f'epoch = "{NOON}"' in system_text(system)


def test_the_command_line_sets_it(file):
    done = CliRunner().invoke(main, ["run", str(file), "--duration", "2", "--epoch", "midnight"])
    assert done.exit_code != 0
    assert "not midnight" in done.stderr
    done = CliRunner().invoke(main, ["run", str(file), "--duration", "2", "--epoch", NOON])
    assert done.exit_code == 0


def test_a_date_of_toml_says_how_to_write_it(file):
    other = file.with_name("other.toml")
    other.write_text(FILE.replace(f'"{NOON}"', "2022-09-18T07:49:21Z"))
    with pytest.raises(SystemCheckError, match=r'write epoch = "2022-09-18T07:49:21.5 UTC"'):
        tf.read_system(other)
