"""Components, ports and parameters at a prompt: reprs, help, call tips and completion."""

import inspect
import pydoc

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component, docstring
from terrafix.cosim.declare.display import (
    port_content,
    port_table,
    setting_content,
    setting_table,
)
from terrafix.cosim.declare.parameters import (
    Choice,
    Count,
    FilePath,
    Flag,
    OptionalFilePath,
    Parameter,
    Table,
)
from terrafix.cosim.declare.ports import (
    BundleInput,
    BundleOutput,
    Field,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    Port,
    SharedInput,
    State,
    WindowInput,
)

ESTIMATE = {
    "r": Field((3,), unit="m", frame="e", doc="position"),
    "v": Field((3,), unit="m/s", frame="e", doc="rate of it"),
}


class Meter(Component):
    """What it reads, with noise.

    More of it.
    """

    default_rate = Rate(hz=4)

    mode = Choice(("fast", "slow"), "fast", doc="how")
    sigma = Parameter(unit="m", minimum=0.0, doc="white noise")
    lever = Parameter([1.0, 0.0, 2.5e7], shape=(3,), unit="m", doc="where it sits")
    many = Parameter(0.0, shape=(4, 4))
    quiet = Flag(False, doc="say nothing")

    truth = Input((3,), unit="m", frame="e", doc="what is so")
    prior = BundleInput(ESTIMATE, at="start", doc="what was thought")
    note = MessageInput((2,), unit="s", optional=True)
    reading = Output(unit="m", labels=(), doc="what is read")
    bias = State((3,), unit="m", start=1.0)


class Mute(Meter):
    sound = Output()


BUNDLE = '{"r": Field((3,), unit="m", frame="e"), "v": Field((3,), unit="m/s", frame="e")}'


@pytest.mark.parametrize(
    ("declared", "text"),
    [
        (Input((3,), unit="m/s", frame="b"), 'Input((3,), unit="m/s", frame="b")'),
        (Input(at="start", default=1.0), 'Input(at="start", default=1.0)'),
        (Output((2,), unit=("s", "m"), doc="left out"), 'Output((2,), unit=("s", "m"))'),
        (Output(dtype=np.int64), 'Output(dtype="int64")'),
        (WindowInput((2,), optional=True), "WindowInput((2,), optional=True)"),
        (SharedInput((None, 2)), "SharedInput((None, 2))"),
        (
            MessageInput(queue=3, needed_at_start=True),
            "MessageInput(queue=3, needed_at_start=True)",
        ),
        (MessageOutput((9,), ragged=True), "MessageOutput((9,), ragged=True)"),
        (BundleOutput(ESTIMATE), f"BundleOutput({BUNDLE})"),
        (MessageOutput(fields=ESTIMATE), f"MessageOutput(fields={BUNDLE})"),
        (State((3,), unit="m", start=[1, 2, 3]), 'State((3,), unit="m", start=[1, 2, 3])'),
        (Parameter(1.5, unit="m", minimum=0.0), 'Parameter(1.5, unit="m", minimum=0.0)'),
        (Parameter(shape=(3,), positive=True), "Parameter(shape=(3,), positive=True)"),
        (Choice(("a", "b"), "b"), 'Choice(("a", "b"), "b")'),
        (Count(3), "Count(3)"),
        (Flag(), "Flag()"),
        (Table(), "Table()"),
        (FilePath(), "FilePath()"),
        (OptionalFilePath(), "OptionalFilePath()"),
    ],
)
def test_declarations_are_shown_as_they_are_written(declared, text):
    """Pasted back, they declare the same, but for the meaning that is left out."""
    assert repr(declared) == text
    again = eval(repr(declared), {**globals(), "inf": np.inf})
    assert repr(again) == repr(declared)


def test_many_fields_are_counted():
    fields = {name: Field() for name in "abcdef"}
    shown = repr(BundleOutput(fields))
    assert shown == 'BundleOutput({"a": Field(), "b": Field(), "c": Field(), ... 3 more})'


METER = """Meter, steps every 8.2 s from 1 s

parameter   value
─────────────────────────────
mode        fast
sigma       0.25 m
lever       [1, 0, 2.5e+07] m
many        array (4, 4)
quiet       False

port                                 shape    unit   frame
──────────────────────────────────────────────────────────
truth     input                      3        m      e
prior     input, read at the start   r, v
note      input message              2        s
reading   output                     scalar   m"""


def test_a_component_shows_its_values_and_ports():
    meter = Meter(sigma="25 cm", rate=Rate("8.2", offset="1"))
    assert repr(meter) == METER


def test_what_is_missing_is_said():
    class Timeless(Component):
        """Without a rate of its own."""

        sigma = Parameter(unit="m")

    assert repr(Timeless()) == (
        "Timeless, has no rate yet\n\nparameter   value\n───────────────────\nsigma       missing"
    )


def test_long_components_are_cut():
    body = {f"p{i:02d}": Parameter(float(i)) for i in range(30)}
    body |= {f"o{i:02d}": Output() for i in range(30)}
    shown = repr(type("Long", (Component,), body)())
    assert shown.count("and 20 more") == 2
    assert len(shown.splitlines()) < 32


def test_html_of_a_component_is_escaped():
    class Text(Component):
        """With a value that looks like a tag."""

        mode = Choice(("<b>", "a"), "<b>")

    assert "&lt;b&gt;" in Text()._repr_html_()
    assert "<b>" not in Text()._repr_html_()


def test_a_port_is_named_with_its_declaration():
    assert repr(Meter(sigma=1)["truth"]) == '<(unnamed).truth: Input((3,), unit="m", frame="e")>'


# ---------------------------------------------------------------------- help


HELP = """What it reads, with noise.

More of it.

Parameters
----------
mode : "fast" | "slow", default "fast"
    how
sigma : number [m], required
    white noise
lever : array (3,) [m], default [1.0, 0.0, 25000000.0]
    where it sits
many : array (4, 4), default 0.0
quiet : flag, default False
    say nothing
rate : Rate, default Rate("0.25 s")
    when it steps

Inputs
------
truth : array (3,) [m], frame e
    what is so
prior : bundle, read at the start of the step
    what was thought
    .r array (3,) [m], frame e: position
    .v array (3,) [m/s], frame e: rate of it
note : array (2,) [s], message, optional

Outputs
-------
reading : number [m]
    what is read"""


def test_help_lists_parameters_and_ports_after_the_docstring():
    assert Meter.__doc__ == HELP
    assert inspect.getdoc(Meter) == HELP
    assert Meter(sigma=1).__doc__ == HELP
    shown = pydoc.plain(pydoc.render_doc(Meter))
    assert "sigma : number [m], required" in shown


def test_the_docstring_alone_is_what_was_written():
    assert docstring(Meter) == "What it reads, with noise.\n\nMore of it."
    assert docstring(Mute) == ""
    assert docstring(Component).startswith("Base of every component.")


def test_a_type_without_a_docstring_is_described_by_its_base():
    assert Mute.__doc__ == HELP + "\nsound : number"


def test_a_type_that_declares_nothing_has_its_docstring():
    class Plain(Component):
        """Nothing else."""

    assert Plain.__doc__ == "Nothing else."
    assert Component.__doc__.startswith("Base of every component.")


def test_call_tips_list_parameters():
    signature = inspect.signature(Meter)
    assert list(signature.parameters) == ["mode", "sigma", "lever", "many", "quiet", "rate"]
    assert signature.parameters["sigma"].default is inspect.Parameter.empty
    assert signature.parameters["sigma"].annotation == "number [m]"
    assert signature.parameters["mode"].default == "fast"
    signature.bind(sigma=1.0)
    with pytest.raises(TypeError, match="missing"):
        signature.bind()
    with pytest.raises(TypeError, match="unexpected keyword argument 'sigmma'"):
        signature.bind(sigma=1.0, sigmma=1.0)


def test_a_constructor_of_its_own_keeps_its_signature():
    class Own(Component):
        """Takes what others do not."""

        sigma = Parameter(1.0)

        def __init__(self, plan: int) -> None:
            super().__init__()

    assert list(inspect.signature(Own).parameters) == ["plan"]
    assert list(inspect.signature(Component).parameters) == ["rate", "settings"]


# ---------------------------------------------------------------------- listings


def test_the_table_of_ports_says_of_each_field_what_was_declared():
    ports = {n: p for n, p in Meter.declarations.items() if isinstance(p, Port)}
    ports["image"] = SharedInput((None, 2), dtype=np.complex64, doc="seen")
    ports["outline"] = MessageOutput((4, 2), unit=("m", "s"), ragged=True)
    table = port_table([port_content(name, port) for name, port in ports.items()])
    assert table.headers == ["port", "", "shape", "unit", "frame", "read at", "meaning"]
    assert table.rows == [
        ["truth", "input", "3", "m", "e", "end", "what is so"],
        ["prior", "input", "", "", "", "start", "what was thought"],
        ["  .r", "", "3", "m", "e", "", "position"],
        ["  .v", "", "3", "m/s", "e", "", "rate of it"],
        ["note", "input message", "2", "s", "", "end, optional", ""],
        ["reading", "output", "scalar", "m", "", "", "what is read"],
        ["image", "input shared", "any x 2 complex64", "1", "", "end", "seen"],
        ["outline", "output message", "4 x 2 at most", "m, s", "", "", ""],
    ]


def test_the_table_of_parameters_says_what_each_takes():
    """Defaults as they are written in a system file."""
    content = [setting_content(name, setting) for name, setting in Meter.settings().items()]
    assert setting_table(content).rows == [
        ["mode", '"fast" | "slow"', "fast", "how"],
        ["sigma", "number [m]", "required", "white noise"],
        ["lever", "array (3,) [m]", "[1.0, 0.0, 25000000.0] m", "where it sits"],
        ["many", "array (4, 4)", str(np.zeros((4, 4)).tolist()), ""],
        ["quiet", "flag", "False", "say nothing"],
    ]


def test_a_port_is_told_in_plain_types():
    declared = MessageInput((3,), unit=("m", "m", "s"), labels="xyz", queue=4, default=[1, 2, 3])
    told = port_content("fix", declared)
    assert (told["kind"], told["direction"], told["queue"]) == ("message", "input", 4)
    assert (told["at"], told["optional"], told["default"]) == ("end", True, [1, 2, 3])
    (field,) = told["fields"]
    assert (field["shape"], field["unit"]) == ([3], ["m", "m", "s"])
    assert (field["labels"], field["dtype"]) == (["x", "y", "z"], "float64")
    assert port_content("w", WindowInput())["kind"] == "window"
    assert "queue" not in port_content("u", Input())
    assert "at" not in port_content("y", Output())


# ---------------------------------------------------------------------- completion


def test_ports_are_completed():
    meter = Meter(sigma=1)
    assert meter._ipython_key_completions_() == ["truth", "prior", "note", "reading"]
    assert {"truth", "sigma", "bias", "ports"} <= set(dir(meter))
    meter.ports["late"] = Output()  # as of an FMU, known once its file is read
    assert "late" in dir(meter)


def test_reading_outside_a_simulation_is_answered():
    """An AttributeError, so that completion and `hasattr` go on."""
    meter = Meter()
    with pytest.raises(AttributeError, match=r"'Meter.truth' is a port: .*\[\"truth\"\] names it"):
        meter.truth  # noqa: B018
    with pytest.raises(AttributeError, match=r"'Meter.sigma' has no value yet: .*number \[m\]"):
        meter.sigma  # noqa: B018
    with pytest.raises(AttributeError, match=r"'Meter\.bias' is a state"):
        meter.bias  # noqa: B018
    assert not hasattr(meter, "prior")
