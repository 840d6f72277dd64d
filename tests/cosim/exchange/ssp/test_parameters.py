"""Rules of SSP for parameters, names and versions, on packages of the smallest FMUs."""

from __future__ import annotations

import numpy as np
import pytest
from fmu_helpers import ECOS, in_another_process
from ssp_parts import STEP, bindings, bound, connectors, link, packaged, part, system, values

from terrafix.cli import main
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run.binding import MODEL_EXCHANGE
from terrafix.cosim.exchange.ssp.names import SSC, SSM
from terrafix.cosim.exchange.ssp.reading import read_ssp
from terrafix.cosim.system.check import check

# ------------------------------------------------------------------ what is set


def test_the_higher_level_wins_and_names_are_hierarchical(tmp_path, fmus):
    """a.k: 2 by its own, 3 by system B, 5 by the top; b.k: 3 by B alone, c.k: 2 by its own."""
    own = bindings(bound(k="2"))
    inner = system(
        part("a", inside=own) + part("b", inside=own) + part("c", inside=own),
        name="B",
        before=bindings(bound(a__k="3", b__k="3")),
    )
    file = packaged(tmp_path / "x.ssp", fmus, system(inner, before=bindings(bound(B__a__k="5"))))
    assert values(file, "B_a.y", "B_b.y", "B_c.y") == [5.0, 3.0, 2.0]


def test_of_one_level_the_later_wins_and_a_prefix_comes_first(tmp_path, fmus):
    top = system(
        part("a"), before=bindings(bound(a__k="2"), bound(prefix="a.", k="7"), bound(k="9"))
    )
    assert values(packaged(tmp_path / "x.ssp", fmus, top), "a.y") == [7.0]


def test_connectors_of_systems_hand_on_to_all_their_readers(tmp_path, fmus):
    """gain reaches a.k and, within B, c.k times 3 plus 1; level reaches the inputs of a and b."""
    twice = '<ssc:LinearTransformation factor="3" offset="1"/>'
    inner = system(
        part("c"), link("inside", "c.k", twice), name="B", before=connectors(inside="parameter")
    )
    top = system(
        part("a") + part("b") + inner,
        link("gain", "a.k"),
        link("gain", "B.inside"),
        link("level", "a.u"),
        link("level", "b.u"),
        before=connectors(gain="parameter", level="input") + bindings(bound(gain="2", level="10")),
    )
    file = packaged(tmp_path / "x.ssp", fmus, top)
    assert values(file, "a.y", "b.y", "B_c.y") == [12.0, 11.0, 7.0]
    assert read_ssp(file).exposed == {"level_a": "a.u", "level_b": "b.u"}


def test_all_types_units_and_outputs_whose_start_is_exact(tmp_path, fmus):
    given = bound(
        on=("Boolean", "false"), mode=("Enumeration", "fast"), word=("String", "hello"),
        length="250 cm", kept="8", nobody="1",
    )  # fmt: skip
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a", inside=bindings(given))))
    # said = 10 mode + on + 100 letters
    assert values(file, "a.said", "a.far", "a.kept") == [10 * 3 + 0 + 100 * 5, 2.5, 8.0]


def test_a_value_of_another_type_is_named(tmp_path, fmus):
    given = bindings(bound(mode=("Enumeration", "slow")))
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a", inside=given)))
    with pytest.raises(ConfigurationError, match=r"'mode' takes one of off, on, fast, not 'slow'"):
        read_ssp(file)


def test_text_that_is_connected_is_named(tmp_path, fmus):
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a") + part("b"), link("a.echo", "b.u")))
    with pytest.raises(ConfigurationError, match=r"connects 'a.echo', which is no number"):
        read_ssp(file)


def test_a_connection_overrules_what_is_set_at_its_end(tmp_path, fmus):
    """a.k is connected to gain, 30, and B.a.k to inside and that to gain, also where k is set."""
    own = bindings(bound(k="2"))
    inner = system(
        part("a", inside=own),
        link("inside", "a.k"),
        name="B",
        before=connectors(inside="parameter"),
    )
    given = bindings(bound(gain="30", a__k="10", B__a__k="11", B__inside="12"), bound(a__k="13"))
    top = system(
        part("a", inside=own) + inner,
        link("gain", "a.k"),
        link("gain", "B.inside"),
        before=connectors(gain="parameter") + given,
    )
    assert values(packaged(tmp_path / "x.ssp", fmus, top), "a.y", "B_a.y") == [30.0, 30.0]


def test_one_side_without_a_unit_takes_the_number_as_it_is(tmp_path, fmus):
    """3 m go to u, which has no unit: y = k + u = 4, and a note says so."""
    top = system(part("a", inside=bindings(bound(length="3 m"))) + part("b"), link("a.far", "b.u"))
    file = packaged(tmp_path / "x.ssp", fmus, top)
    assert values(file, "b.y") == [4.0]
    assert "'b.u' has no unit: taken as m, that of what it reads" in check(read_ssp(file)).notes


def test_units_in_brackets_as_simulink_writes_them(tmp_path, fmus):
    given = bound(length="2 m").replace('unit="m"', 'unit="[m]"')
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a", inside=bindings(given))))
    assert values(file, "a.far") == [2.0]


def test_mappings_inline_and_in_a_file(tmp_path, fmus):
    """length = 2 * 3 m + 0.5; mode by a table from 7 to 2; k, not mapped, is not applied.

    "Non-mapped parameter values are not applied in this case." (SSP 2.0, 5.2.4)
    """
    entries = (
        '<ssm:MappingEntry source="L" target="length"><ssc:LinearTransformation factor="2" '
        'offset="0.5"/></ssm:MappingEntry><ssm:MappingEntry source="number" target="mode">'
        '<ssc:IntegerMappingTransformation><ssc:MapEntry source="7" target="2"/>'
        "</ssc:IntegerMappingTransformation></ssm:MappingEntry>"
    )
    mapping = (
        f'<ssm:ParameterMapping xmlns:ssm="{SSM}" xmlns:ssc="{SSC}" version="1.0">{entries}'
        "</ssm:ParameterMapping>"
    )
    given = {"L": "300 cm", "number": ("Integer", "7"), "k": "6"}
    inline = f"<ssd:ParameterMapping>{mapping}</ssd:ParameterMapping>"
    for how, files in (
        (inline, {}),
        ('<ssd:ParameterMapping source="m.ssm"/>', {"m_ssm": mapping}),
    ):
        top = system(part("a", inside=bindings(bound(mapping=how, **given))))
        file = packaged(tmp_path / "x.ssp", fmus, top, **files)
        assert values(file, "a.far", "a.said", "a.y") == [6.5, 20 + 1 + 200, 1.0]


def test_a_table_leaves_what_it_does_not_list(tmp_path, fmus):
    """8 is not listed, and 3 is fast: "values not mapped ... are kept unchanged" (SSP 2.0)."""
    table = "<ssc:MapEntry source='7' target='2'/>"
    for given, mode in (("7", 2), ("3", 3)):
        mapping = (
            '<ssd:ParameterMapping><ssm:ParameterMapping version="1.0"><ssm:MappingEntry '
            'source="n" target="mode"><ssc:IntegerMappingTransformation>'
            f"{table}</ssc:IntegerMappingTransformation></ssm:MappingEntry>"
            "</ssm:ParameterMapping></ssd:ParameterMapping>"
        )
        top = system(part("a", inside=bindings(bound(mapping=mapping, n=("Integer", given)))))
        file = packaged(tmp_path / "x.ssp", fmus, top)
        assert values(file, "a.said") == [10 * mode + 1 + 200]


def test_one_name_of_two_things_sets_both(tmp_path, fmus):
    """B.C in the top, and C in B, whose k are both B.C.k (SSP 2.0, 5.2.4, "punning")."""
    inner = system(part("C"), name="B")
    top = system(part("B.C") + inner, before=bindings(bound(B__C__k="3")))
    assert values(packaged(tmp_path / "x.ssp", fmus, top), "B_C.y", "B_C_2.y") == [3.0, 3.0]


# ------------------------------------------------------------------ names, kinds, times, versions


def test_names_that_read_alike_are_kept_apart(tmp_path, fmus):
    top = system(
        part("a-b", inside=bindings(bound(k="2"))) + part("a b", inside=bindings(bound(k="3"))),
        link("a b.y", "a-b.u"),
    )
    file = packaged(tmp_path / "x.ssp", fmus, top)
    assert values(file, "a_b.y", "a_b_2.y") == [5.0, 3.0]


def test_one_name_twice_is_an_error(tmp_path, fmus):
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a") + part("a")))
    with pytest.raises(ConfigurationError, match=r"system 'top' has two elements 'a'"):
        read_ssp(file)


def test_an_fmu_is_run_as_its_component_says(tmp_path, spring, fmus):
    wanted = part("a", "s", more='implementation="ModelExchange"')
    file = packaged(tmp_path / "x.ssp", {"s": spring(2).read_bytes()}, system(wanted))
    assert read_ssp(file).nodes["a"].interface.kind == MODEL_EXCHANGE
    for kind, said in (("ScheduledExecution", "wants its FMU run by ScheduledExecution"),
                       ("ModelExchange", "offers co-simulation, not model exchange")):  # fmt: skip
        wanted = part("a", more=f'implementation="{kind}"')
        file = packaged(tmp_path / "x.ssp", fmus, system(wanted))
        with pytest.raises(ConfigurationError, match=said):
            read_ssp(file)


def test_an_experiment_that_starts_later(tmp_path, fmus):
    """From 5 s to 7 s: two seconds here, and the FMU is told 5 s, then 5.1 s."""
    file = packaged(
        tmp_path / "x.ssp", fmus, system(part("a")), experiment='startTime="5" stopTime="7"'
    )
    assert read_ssp(file).duration == 2
    assert values(file, "a.time") == [5.0]
    assert values(file, "a.time", t="0.1") == pytest.approx([5.1])


def test_versions(tmp_path, fmus):
    for version in ("1.0", "1.1-beta", "2.0"):
        file = packaged(tmp_path / "x.ssp", fmus, system(part("a")), version=version)
        assert values(file, "a.y") == [1.0]
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a")), version="3.0")
    with pytest.raises(ConfigurationError, match=r"is of version 3.0 of SSP; terrafix reads 1.x"):
        read_ssp(file)


def test_the_system_itself_and_which_way_a_connection_goes(tmp_path, fmus):
    """An empty element is the system, as an absent one; start and end are no direction."""
    given = bindings(bound(k="4"))
    backward = link("b.u", "a.y")
    owned = (
        '<ssd:Connection startElement="" startConnector="gain" endElement="b" endConnector="k"/>'
    )
    b = part("b", inside=connectors(u="input"))
    top = system(
        part("a", inside=connectors(y="output") + given) + b,
        backward,
        owned,
        before=connectors(gain="parameter") + bindings(bound(gain="20")),
    )
    assert values(packaged(tmp_path / "x.ssp", fmus, top), "b.y") == [24.0]


def test_a_state_that_starts_from_an_input_is_what_ecos_has(tmp_path, fmus):
    """p.x(0) = 1, so q starts at 1, and is 1.1 after a step, 1.21 after two (x = 1 + t)."""
    shown = part("p", "p", connectors(x="output")) + part(
        "q", "q", connectors(u="input", y="output")
    )
    file = packaged(tmp_path / "x.ssp", fmus, system(shown, link("p.x", "q.u")))
    here = [values(file, "q.y", t=t)[0] for t in ("0", "0.1", "0.2")]
    assert here == pytest.approx([1.0, 1.1, 1.21], abs=1e-15)
    code = ECOS.replace("step_size=0.01", "step_size=0.1")
    there = [in_another_process("ecospy", code, file, n, "q::y")[0] for n in (1, 2)]
    assert np.array_equal(there, here[1:])


def test_prefixes_that_nobody_declared(tmp_path, fmus):
    """As in packages of the Open Simulation Platform: read as everybody means them, and told."""
    given = part("a", inside=bindings(bound(k="4")))
    file = packaged(tmp_path / "x.ssp", fmus, system(given), declared=False)
    assert values(file, "a.y") == [4.0]
    assert (
        "SystemStructure.ssd does not declare the prefixes ssv, ssc, osp: read as everybody means it"
        in check(read_ssp(file)).notes
    )


def test_damaged_xml_is_named(tmp_path, fmus):
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a")) + "<ssd:open>")
    with pytest.raises(ConfigurationError, match=r"SystemStructure.ssd is damaged: mismatched tag"):
        read_ssp(file)


def test_a_step_size_is_asked_for_by_name(tmp_path, fmus, capsys):
    """Where neither package nor FMU gives one; one that is named overrules the package."""

    def run(*words):
        with pytest.raises(SystemExit) as done:
            main([str(w) for w in words])
        return done.value.code, capsys.readouterr()

    file = packaged(tmp_path / "x.ssp", fmus, system(part("a") + part("b")), step="")
    code, said = run("run", file, "--duration", "1", "--quiet")
    assert code == 2
    assert "give it one: --rate a=100Hz, or --rate 100Hz for all without one" in said.err
    assert run("run", file, "--rate", "10Hz", "--duration", "1", "--quiet")[0] == 0
    made = read_ssp(file, [("rate", "10 Hz"), ("b.period", "0.5 s")])
    assert [float(made.nodes[n].rate.period) for n in "ab"] == [0.1, 0.5]
    code, said = run("check", file, "--rate", "10Hz", "--rate", "c=5Hz")
    assert (code, "--rate names 'c', which is no component" in said.err) == (2, True)
    code, said = run("check", file, "--rate", "10Hz", "--rate", "a=5Hz", "--rate", "b=5Hz")
    assert (code, "--rate without a name does nothing" in said.err) == (2, True)
    code, said = run("check", file, "--rate", "a=fast")
    assert (code, "--rate a=fast" in said.err) == (2, True)
    target = tmp_path / "x.toml"
    assert run("ssp", "import", file, "--rate", "0.1s", "-o", target)[0] == 0
    assert "0.1" in target.read_text()


def test_values_that_nothing_takes_are_told(tmp_path, fmus):
    """The standard has them ignored; those of `length` and u are taken."""
    top = system(part("a"), before=bindings(bound(a__kk="1", b__k="1", a__length="2", a__u="3")))
    file = packaged(tmp_path / "x.ssp", fmus, top)
    notes = [note for note in check(read_ssp(file)).notes if "nothing" in note]
    assert notes == [
        "'a' has nothing that takes the values of 'kk': ignored",
        "the system has nothing that takes the values of 'b.k': ignored",
    ]


def test_a_package_within_a_package(tmp_path, fmus):
    """What is bound to the component overrules the inner package's own: k 7, not 3."""
    inner = system(
        part("a", inside=bindings(bound(k="2"))),
        link("a.y", "out"),
        link("in", "a.u"),
        before=connectors(**{"in": "input", "out": "output"}) + bindings(bound(a__k="3")),
    )
    held = packaged(tmp_path / "inner.ssp", fmus, inner).read_bytes()
    component = (
        '<ssd:Component name="B" type="application/x-ssp-package" source="in%20ner.ssp">'
        + bindings(bound(a__k="7"))
        + "</ssd:Component>"
    )
    top = system(component + part("c"), link("c.y", "B.in"), link("B.out", "c.u"))
    file = packaged(tmp_path / "x.ssp", fmus, top, **{"in ner.ssp": held})
    made = read_ssp(file)
    assert sorted(map(str, made.connections)) == ["B_a.y -> c.u", "c.y -> B_a.u"]
    file = packaged(tmp_path / "y.ssp", fmus, system(component), **{"in ner.ssp": held})
    assert values(file, "B_a.y") == [7.0]


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ({"experiment": 'startTime="0" stopTime="soon"'}, "stopTime of its experiment is 'soon'"),
        ({"experiment": 'startTime="5" stopTime="2"'}, "stops at 2 s and starts at 5 s"),
        ({"step": STEP.replace('"0.1"', '"quick"')}, "FixedStepAlgorithm is 'quick', which is no"),
    ],
)
def test_numbers_that_are_none(tmp_path, fmus, written, message):
    file = packaged(tmp_path / "x.ssp", fmus, system(part("a")), **written)
    with pytest.raises(ConfigurationError, match=message):
        read_ssp(file)


def test_what_is_wrong_with_an_fmu_names_the_package_and_not_a_temporary_folder(tmp_path):
    file = packaged(tmp_path / "x.ssp", {"k": b"no archive"}, system(part("a")))
    with pytest.raises(ConfigurationError, match=r"x.ssp': 'a': 'k.fmu' is no FMU"):
        read_ssp(file)
