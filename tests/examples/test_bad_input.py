"""Seeded mistakes: each is found before the first step, once, in words that say what to do next.

Most are made to a copy of the open loop, by editing its text or with ``--set``; the whole message
is held. A message names both sides and the next thing to try, and no mistake is reported a second
time by what follows from it.
"""

import functools
import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner

import terrafix.components.filters.mekf
import terrafix.components.sensors.imu
import terrafix.components.sensors.sar
import terrafix.components.truth.attitude
import terrafix.components.truth.orbit
from terrafix.cli import main
from terrafix.cosim.basics.errors import SystemCheckError, TerrafixError
from terrafix.cosim.engine.master import Master
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system

EXAMPLES = Path(__file__).parents[2] / "examples"
OPEN_LOOP = (EXAMPLES / "spacecraft_sar_open_loop.toml").read_text()

PROJECT = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text())["project"]
TYPES = ", ".join(sorted(PROJECT["entry-points"]["terrafix.components"]))

JARGON = re.compile(
    r"Traceback|NoneType|None\b|KeyError|TypeError|AttributeError|object has no|\[Errno|<class|"
    r"dtype|datetime|codec|pickle|\bTrue\b|\bFalse\b"
)

ORBIT_TO_ATTITUDE = '"orbit.r_e -> attitude.r_e"'
TRUTH = 'ports = ["orbit.r_e", "orbit.v_e"]\nperiod = "8.2 s"'
DISPERSION = '\n[dispersion.start]\nto = ["orbit.r0_i"]\nsigma = "10 m"\n'


@dataclass(frozen=True)
class Mistake:
    """What is written wrong, and what is said about it."""

    said: str
    edits: tuple[tuple[str, str], ...] = ()  # text of the open loop, and what replaces it
    more: str = ""  # appended to it
    settings: tuple[tuple[str, str], ...] = ()


def edit(old: str, new: str, said: str, **others) -> Mistake:
    return Mistake(said, ((old, new),), **others)


def append(more: str, said: str) -> Mistake:
    return Mistake(said, more=more)


def setting(path: str, value: str, said: str) -> Mistake:
    return Mistake(said, settings=((path, value),))


def wire(entry: str, said: str) -> Mistake:
    """One connection written otherwise."""
    return edit(ORBIT_TO_ATTITUDE, entry, said)


SYSTEM_MISTAKES = {
    # ---------------------------------------------------------------- components and parameters
    "unknown type": edit(
        'type = "imu"',
        'type = "imuu"',
        "ConfigurationError: 'imu': there is no component type 'imuu'\n  did you mean 'imu'?",
    ),
    "type that is no name": edit(
        'type = "imu"',
        "type = 3",
        "ConfigurationError: 'imu' has the type 3, which is no name\n"
        f"  component types: {TYPES}",
    ),
    "table that is misspelled": edit(
        "[component.orbit]",
        "[componet.orbit]",
        "ConfigurationError: there is no key 'componet'\n  did you mean 'component'?",
    ),
    "component that is no table": edit(
        "[component.orbit]",
        '[component]\ngyro = "imu"\n\n[component.orbit]',
        "ConfigurationError: 'component.gyro' is 'imu', not a table\n"
        "  begin one with [component.gyro]",
    ),
    "name that is none": append(
        '\n[component."star tracker"]\ntype = "attitude_sensor"\n',
        "ConfigurationError: 'star tracker' cannot name a component: use letters, digits and "
        "underscores, a letter first",
    ),
    "unknown parameter": edit(
        'speed_sigma = "0.54 m/s"',
        'beamwidth = "1 deg"',
        "ConfigurationError: 'sar' has no parameter 'beamwidth'\n"
        "  its parameters: boresight, error_scale, flattening, geolocation_bias, "
        "geolocation_sigma, in_track, look, offset, period, radius, range_sigma, rate, "
        "speed_sigma, squint, times",
    ),
    "misspelled parameter": edit(
        'gravity = "j2"',
        'gravty = "j2"',
        "ConfigurationError: 'orbit' has no parameter 'gravty'\n  did you mean 'gravity'?",
    ),
    "misspelled parameter that is required": edit(
        "r0_i = ",
        "r0i = ",
        "ConfigurationError: 'orbit' has no parameter 'r0i'\n  did you mean 'r0_i'?",
    ),
    "required parameter left out": edit(
        'look = "34.3 deg"\nrange_sigma',
        "range_sigma",
        "ConfigurationError: 'sar' needs a value for 'look': it takes number [rad]",
    ),
    "wrong unit": edit(
        'range_sigma = "1 m"',
        'range_sigma = "1 s"',
        "ConfigurationError: 'sar.range_sigma' is given in s; it takes number [m]\n"
        "  the units differ: s is not m",
    ),
    "unit that is none": edit(
        'range_sigma = "1 m"',
        'range_sigma = "1 metrs"',
        "ConfigurationError: 'sar.range_sigma' is given in metrs: 'metrs' is not a unit\n"
        '  write it as in "m/s^2", "rad", "deg/h" or "1"',
    ),
    "unit left out of a number": edit(
        'range_sigma = "1 m"',
        "range_sigma = 1.0",
        "ConfigurationError: 'sar.range_sigma' has no unit\n"
        '  it takes number [m]: write "1.0 m"',
    ),
    "unit left out of a text": edit(
        'range_sigma = "1 m"',
        'range_sigma = "1"',
        "ConfigurationError: 'sar.range_sigma' has no unit\n"
        '  it takes number [m]: write "1.0 m"',
    ),
    "text for a number": edit(
        'range_sigma = "1 m"',
        'range_sigma = "one meter"',
        "ConfigurationError: 'sar.range_sigma' is 'one meter', which is not a number with a unit\n"
        '  it takes number [m]: write "1.0 m"',
    ),
    "true for a number": edit(
        'range_sigma = "1 m"',
        "range_sigma = true",
        "ConfigurationError: 'sar.range_sigma' is true; it takes number [m]: write \"1.0 m\"",
    ),
    "date for a number": edit(
        'range_sigma = "1 m"',
        "range_sigma = 2026-01-01",
        "ConfigurationError: 'sar.range_sigma' is 2026-01-01; it takes number [m]: "
        'write "1.0 m"',
    ),
    "wrong shape": edit(
        "-6096830.387203118, 3395727.381187697] m",
        "-6096830.387203118] m",
        "ConfigurationError: 'orbit.r0_i' has shape (2,); it takes array (3,) [m]: "
        'write "[1.0, 1.0, 1.0] m"',
    ),
    "list for a number": edit(
        'range_sigma = "1 m"',
        'range_sigma = "[1, 2] m"',
        "ConfigurationError: 'sar.range_sigma' has shape (2,); it takes number [m]: "
        'write "1.0 m"',
    ),
    "not a number": edit(
        'range_sigma = "1 m"',
        "range_sigma = nan",
        "ConfigurationError: 'sar.range_sigma' is nan; it must be finite",
    ),
    "infinite": edit(
        'position_sigma = "1000 m"',
        'position_sigma = "[1000, inf, 1000] m"',
        "ConfigurationError: 'last_known.position_sigma' is [1000.0, inf, 1000.0]; "
        "it must be finite",
    ),
    "negative where that is impossible": edit(
        'range_sigma = "1 m"',
        'range_sigma = "-1 m"',
        "ConfigurationError: 'sar.range_sigma' is -1.0 m; it must be at least 0 m",
    ),
    "zero where that is impossible": edit(
        'velocity_sigma = "10 m/s"',
        'velocity_sigma = "0 m/s"',
        "ConfigurationError: 'last_known.velocity_sigma' is [0.0, 0.0, 0.0] m/s; "
        "it must be positive",
    ),
    "too large": setting(
        "sar.flattening",
        "0.5",
        "ConfigurationError: 'sar.flattening' is 0.5; it must be at most 0.1",
    ),
    "wrong choice": edit(
        'gravity = "j2"',
        'gravity = "j3"',
        "ConfigurationError: 'orbit.gravity' is 'j3'; it takes \"two-body\" or \"j2\"",
    ),
    "number for a choice": edit(
        'gravity = "j2"',
        "gravity = 2",
        "ConfigurationError: 'orbit.gravity' is 2; it takes \"two-body\" or \"j2\"\n"
        "  did you mean 'j2'?",
    ),
    "neither true nor false": edit(
        'gravity = "j2"',
        'drag = "maybe"',
        "ConfigurationError: 'orbit.drag' is 'maybe'; it takes true or false",
    ),
    # ---------------------------------------------------------------- time
    "rate in words": edit(
        'rate = "100 Hz"',
        'rate = "often"',
        "RateError: 'orbit': rate is 'often', which is not a rate in hertz\n"
        '  write a number such as "8.2", "1/30" or "100 Hz" (units: Hz, kHz, MHz)',
    ),
    "rate in millihertz": edit(
        'rate = "100 Hz"',
        'rate = "100 mHz"',
        "RateError: 'orbit': rate is '100 mHz', which is not a rate in hertz\n"
        '  write a number such as "8.2", "1/30" or "100 Hz" (units: Hz, kHz, MHz)',
    ),
    "float period": edit(
        'period = "8.2 s"',
        "period = 8.2",
        "RateError: 'antenna': period is 8.2, a binary fraction near 8.2\n"
        '  write "8.2" (exact) or "41/5"',
    ),
    "negative period": edit(
        'period = "8.2 s"',
        'period = "-8.2 s"',
        "RateError: 'antenna': period is -8.2 s; it must be positive",
    ),
    "zero period": edit(
        'period = "8.2 s"',
        'period = "0 s"',
        "RateError: 'antenna': period is 0 s; it must be positive",
    ),
    "zero rate": edit(
        'rate = "100 Hz"',
        'rate = "0 Hz"',
        "RateError: 'orbit': rate is 0 Hz; it must be positive",
    ),
    "negative offset": edit(
        'offset = "8.2 s"',
        'offset = "-8.2 s"',
        "RateError: 'sar': offset is -8.2 s; it must not be negative",
    ),
    "offset without a period": edit(
        'period = "8.2 s"\noffset = "8.2 s"',
        'offset = "8.2 s"',
        "RateError: 'sar' has an offset but no period\n  give it a period or a rate too",
    ),
    "rate and period": edit(
        'rate = "100 Hz"',
        'rate = "100 Hz"\nperiod = "0.01 s"',
        "RateError: 'orbit' has rate and period\n  give one of them",
    ),
    "times that are no list": edit(
        'times = ["0 s"]',
        "times = 0",
        "RateError: 'last_known': times is 0; write a list, [\"0 s\", \"10 s\"]",
    ),
    "times that go back": edit(
        'times = ["0 s"]',
        'times = ["1 s", "0 s"]',
        "RateError: 'last_known': times must be increasing and not negative",
    ),
    "duration in words": setting(
        "duration",
        "soon",
        "RateError: duration is 'soon', which is not a time in seconds\n"
        '  write a number such as "8.2", "1/30" or "10 ms" (units: s, ms, us, min, h)',
    ),
    "negative duration": edit(
        'duration = "590.4 s"',
        'duration = "-590.4 s"',
        "RateError: duration is -590.4 s; it must be positive",
    ),
    "float duration": edit(
        'duration = "590.4 s"',
        "duration = 590.4",
        "RateError: duration is 590.4, a binary fraction near 590.4\n"
        '  write "590.4" (exact) or "2952/5"',
    ),
    "no members": edit(
        "members = 100",
        "members = 0",
        "ConfigurationError: 'members' is 0; it must be at least 1",
    ),
    "part of a member": edit(
        "members = 100",
        "members = 1.5",
        "ConfigurationError: 'members' is 1.5; it takes a whole number",
    ),
    # ---------------------------------------------------------------- wiring
    "unknown port of the source": wire(
        '"orbit.r_ecef -> attitude.r_e"',
        "WiringError: cannot connect 'orbit.r_ecef' to 'attitude.r_e'\n"
        "  'orbit' has no port 'r_ecef'\n  did you mean 'r_e'?",
    ),
    "unknown port of the target": wire(
        '"orbit.r_e -> attitude.position"',
        "WiringError: cannot connect 'orbit.r_e' to 'attitude.position'\n"
        "  'attitude' has no port 'position'\n"
        "  its ports: delta_theta_b, delta_v_b, delta_v_e, q_be, r_e, v_e",
    ),
    "unknown component at the source": wire(
        '"orbitt.r_e -> attitude.r_e"',
        "WiringError: cannot connect 'orbitt.r_e' to 'attitude.r_e'\n"
        "  there is no component 'orbitt' in 'orbitt.r_e'\n  did you mean 'orbit'?",
    ),
    "unknown component at the target": wire(
        '"orbit.r_e -> atitude.r_e"',
        "WiringError: cannot connect 'orbit.r_e' to 'atitude.r_e'\n"
        "  there is no component 'atitude' in 'atitude.r_e'\n  did you mean 'attitude'?",
    ),
    "component of another name": edit(
        "[component.orbit]",
        "[component.orbiter]",
        "WiringError: cannot connect 'orbit.r_e' to 'attitude.r_e'\n"
        "  there is no component 'orbit' in 'orbit.r_e'\n  did you mean 'orbiter'?",
    ),
    "wrong shape of a port": wire(
        '"attitude.q_be -> attitude.r_e"',
        "WiringError: cannot connect 'attitude.q_be' to 'attitude.r_e'\n"
        "  attitude.q_be  output  shape (4,)  unit 1  frame b\n"
        "  attitude.r_e   input   shape (3,)  unit m  frame e\n"
        "  the shapes differ: (4,) is not (3,)",
    ),
    "wrong unit of a port": wire(
        '"orbit.v_e -> attitude.r_e"',
        "WiringError: cannot connect 'orbit.v_e' to 'attitude.r_e'\n"
        "  orbit.v_e     output  shape (3,)  unit m/s  frame e\n"
        "  attitude.r_e  input   shape (3,)  unit m    frame e\n"
        "  the units differ: m/s is not m",
    ),
    "wrong frame": wire(
        '"orbit.r_i -> attitude.r_e"',
        "WiringError: cannot connect 'orbit.r_i' to 'attitude.r_e'\n"
        "  orbit.r_i     output  shape (3,)  unit m  frame i\n"
        "  attitude.r_e  input   shape (3,)  unit m  frame e\n"
        "  the frames differ: i is not e",
    ),
    "message to a signal": wire(
        '"last_known.state -> attitude.r_e"',
        "WiringError: cannot connect 'last_known.state' to 'attitude.r_e'\n"
        "  last_known.state.r_e  output message  shape (3,)    unit m    frame e\n"
        "  last_known.state.v_e  output message  shape (3,)    unit m/s  frame e\n"
        "  last_known.state.P    output message  shape (6, 6)  unit 1\n"
        "  attitude.r_e          input           shape (3,)    unit m    frame e\n"
        "  a message cannot feed a signal: a message has a time of validity and is fresh once, "
        "a signal is held",
    ),
    "other fields": edit(
        '"predict.prior -> correct.prior"',
        '"orbit.r_e -> correct.prior"',
        "WiringError: cannot connect 'orbit.r_e' to 'correct.prior'\n"
        "  orbit.r_e           output  shape (3,)    unit m    frame e\n"
        "  correct.prior.r_e   input   shape (3,)    unit m    frame e\n"
        "  correct.prior.v_e   input   shape (3,)    unit m/s  frame e\n"
        "  correct.prior.q_mu  input   shape (4,)    unit 1    frame s\n"
        "  correct.prior.P     input   shape (9, 9)  unit 1\n"
        "  the fields differ: no fields is not r_e, v_e, q_mu, P",
    ),
    "output to output": wire(
        '"orbit.r_e -> attitude.q_be"',
        "WiringError: cannot connect 'orbit.r_e' to 'attitude.q_be'\n"
        "  orbit.r_e      output  shape (3,)  unit m  frame e\n"
        "  attitude.q_be  output  shape (4,)  unit 1  frame b\n"
        "  attitude.q_be is an output; a connection ends at an input",
    ),
    "input to input": wire(
        '"sar.r_e -> attitude.r_e"',
        "WiringError: cannot connect 'sar.r_e' to 'attitude.r_e'\n"
        "  sar.r_e       input  shape (3,)  unit m  frame e\n"
        "  attitude.r_e  input  shape (3,)  unit m  frame e\n"
        "  sar.r_e is an input; a connection goes from an output to an input",
    ),
    "unconnected input": edit(
        '    "attitude.delta_v_b -> imu.delta_v_b_true",\n',
        "",
        "WiringError: input 'imu.delta_v_b_true' is not connected and has no default\n"
        "  outputs of the same shape, unit and frame: 'attitude.delta_v_b'",
    ),
    "two drivers": wire(
        '"orbit.r_e -> attitude.r_e", "evaluation.position_error -> attitude.r_e"',
        "WiringError: input 'attitude.r_e' has two drivers\n"
        "  'orbit.r_e' is connected to it already\n"
        "  'evaluation.position_error' cannot be connected too: remove one of them",
    ),
    "loop of one": edit(
        '"predict.prior -> correct.prior"',
        '"correct.estimate -> correct.prior"',
        "WiringError: algebraic loop\n"
        "  correct.estimate -> correct.prior    connected\n"
        "  correct.prior    => correct.estimate read at the end of the step\n"
        "  connect an output that does not depend on the loop (a filter's 'prior', say), read one "
        "of these inputs at the start of its step, or give one connection a delay",
    ),
    "loop of three": edit(
        '"attitude.q_be -> ads.q_be_true"',
        '"second.q_be -> ads.q_be_true", "ads.q_be -> first.q_be_true", '
        '"first.q_be -> second.q_be_true"',
        "WiringError: algebraic loop\n"
        "  ads.q_be         -> first.q_be_true  connected\n"
        "  first.q_be_true  => first.q_be       read at the end of the step\n"
        "  first.q_be       -> second.q_be_true connected\n"
        "  second.q_be_true => second.q_be      read at the end of the step\n"
        "  second.q_be      -> ads.q_be_true    connected\n"
        "  ads.q_be_true    => ads.q_be         read at the end of the step\n"
        "  connect an output that does not depend on the loop (a filter's 'prior', say), read one "
        "of these inputs at the start of its step, or give one connection a delay",
        more='\n[component.first]\ntype = "attitude_sensor"\n'
        '\n[component.second]\ntype = "attitude_sensor"\n',
    ),
    "malformed connection": wire(
        '"orbit.r_e => attitude.r_e"',
        "WiringError: 'orbit.r_e => attitude.r_e' is no connection\n"
        '  write "orbit.r_e -> attitude.r_e", with "(delay 0.1 s)" where there is one',
    ),
    "connection that is no text": wire(
        "3",
        "WiringError: 3 is no connection\n"
        '  write "orbit.r_e -> attitude.r_e", with "(delay 0.1 s)" where there is one',
    ),
    "negative delay": wire(
        '"orbit.r_e -> attitude.r_e (delay -1 s)"',
        "RateError: delay of 'orbit.r_e -> attitude.r_e' is negative\n"
        "  a connection hands on what was published, never what will be",
    ),
    "unknown key of the wiring": edit(
        "connect = [",
        "connections = [",
        "ConfigurationError: [wiring]: there is no key 'connections'\n  did you mean 'connect'?",
    ),
    "exposing what is not there": append(
        '\n[expose]\nposition = "orbit.r_ee"\n',
        "WiringError: cannot expose 'position'\n"
        "  'orbit' has no port 'r_ee'\n  did you mean 'r_e'?",
    ),
    # ---------------------------------------------------------------- settings
    "setting of an unknown component": setting(
        "orbitt.gravity",
        "j2",
        "ConfigurationError: cannot set 'orbitt.gravity': there is no 'orbitt'\n"
        "  did you mean 'orbit'?",
    ),
    "setting of an unknown parameter": setting(
        "orbit.gravty",
        "j2",
        "ConfigurationError: 'orbit' has no parameter 'gravty'\n  did you mean 'gravity'?",
    ),
    "setting of an unknown option": setting(
        "case",
        "TC-3",
        "ConfigurationError: choice 'case' is 'TC-3'; it takes TC-1 or TC-2\n"
        "  did you mean 'TC-2'?",
    ),
    "setting of nothing": setting(
        "sensors",
        "3",
        "ConfigurationError: cannot set 'sensors': there is no 'sensors'\n"
        "  what can be set: ads, antenna, attitude, case, config, correct, dispersion, doc, "
        "duration, epoch, evaluation, imu, last_known, members, name, orbit, predict, record, "
        "sar, seed",
    ),
    "epoch of an orbit that has no frame": setting(
        "epoch",
        "2022-09-18T07:49:21 UTC",
        "ConfigurationError: 'orbit.r0_i' and 'v0_i' are of no frame that has a date, in a system "
        "with the epoch '2022-09-18T07:49:21 UTC': taken for GCRF or TEME they lie up to 36 km "
        "off\n  take a component of type satellite and one of type orbit_start, which is told the "
        "frame; or leave the epoch out",
    ),
    "setting of a component": setting(
        "orbit",
        "j2",
        "ConfigurationError: cannot set 'orbit': it is a component\n"
        "  set one of its parameters: 'orbit.NAME'",
    ),
    "setting by the path in the file": setting(
        "component.orbit.gravity",
        "j2",
        "ConfigurationError: cannot set 'component.orbit.gravity'\n"
        "  did you mean 'orbit.gravity'?",
    ),
    "setting of what stands in the file alone": setting(
        "schema",
        "terrafix-system/2",
        "ConfigurationError: cannot set 'schema'\n  it is written in the file alone",
    ),
    "setting of an unknown record": setting(
        "record.truht.period",
        "1",
        "ConfigurationError: cannot set 'record.truht.period'\n"
        "  did you mean 'record.truth.period'?",
    ),
    "setting to what cannot be": setting(
        "seed", "-1", "ConfigurationError: 'seed' is -1; it must be at least 0"
    ),
    "typing error in an option that is not chosen": edit(
        '[choice.case.TC-1]\n"antenna.misalignment_sigma0" = "0.1 deg"',
        '[choice.case.TC-1]\n"antena.misalignment_sigma0" = "0.1 deg"',
        "ConfigurationError: cannot set 'antena.misalignment_sigma0': there is no 'antena'\n"
        "  did you mean 'antenna'?",
    ),
    "wrong unit in an option that is not chosen": edit(
        '[choice.case.TC-1]\n"antenna.misalignment_sigma0" = "0.1 deg"',
        '[choice.case.TC-1]\n"antenna.misalignment_sigma0" = "0.1 s"',
        "ConfigurationError: 'antenna.misalignment_sigma0' is given in s; it takes number [rad]\n"
        "  the units differ: s is not rad",
    ),
    "choice without a default": edit(
        'default = "TC-2"\n',
        "",
        "ConfigurationError: choice 'case' has no default\n  it takes TC-1 or TC-2",
    ),
    # ---------------------------------------------------------------- keys, records, dispersions
    "unknown key": edit(
        "members = 100",
        "membres = 100",
        "ConfigurationError: there is no key 'membres'\n  did you mean 'members'?",
    ),
    "unknown key of a record": edit(
        "[record.truth]",
        '[record.truth]\nevery = "1 s"',
        "ConfigurationError: record 'truth': there is no key 'every'\n"
        "  keys: doc, offset, period, ports, rate, times",
    ),
    "no schema": edit(
        'schema = "terrafix-system/1"\n',
        "",
        "ConfigurationError: '{path}' has no schema\n"
        '  write schema = "terrafix-system/1" first',
    ),
    "record of an unknown port": edit(
        TRUTH,
        TRUTH.replace("v_e", "speed"),
        "WiringError: record 'truth' names 'orbit.speed'\n  'orbit' has no port 'speed'\n"
        "  its ports: delta_v_e, r_e, r_i, v_e, v_i",
    ),
    "record of no port": edit(
        TRUTH,
        TRUTH.replace("orbit.v_e", "orbit"),
        "WiringError: record 'truth' names 'orbit'\n"
        "  'orbit' is no port; write 'component.port'",
    ),
    "record of an input": edit(
        TRUTH,
        TRUTH.replace("orbit.v_e", "sar.v_e"),
        "WiringError: record 'truth' names the input 'sar.v_e'\n"
        "  record the output that feeds it: 'orbit.v_e'",
    ),
    "record faster than the system": edit(
        TRUTH,
        'ports = ["orbit.r_e"]\ntimes = ["1 s", "1.001 s"]',
        "RateError: record 'truth' has the times 1 s and 1.001 s, closer than the base step of "
        "0.01 s\n  leave one out, or give another component a finer period",
    ),
    "record without a rate": edit(
        TRUTH,
        'ports = ["orbit.r_e", "antenna.q_mu"]',
        "RateError: record 'truth' watches components of different rates "
        "(every 0.01 s, every 8.2 s)\n  give it a period of its own",
    ),
    "dispersion of an unknown component": append(
        DISPERSION.replace("orbit.", "orbt."),
        "ConfigurationError: dispersion 'start' feeds 'orbt.r0_i', but there is no component "
        "'orbt'\n  did you mean 'orbit'?",
    ),
    "dispersion of an unknown parameter": append(
        DISPERSION.replace("r0_i", "r0"),
        "ConfigurationError: dispersion 'start' feeds 'orbit.r0', which is no numeric parameter\n"
        "  did you mean 'r0_i'?",
    ),
    "dispersion of a choice": append(
        DISPERSION.replace("r0_i", "gravity"),
        "ConfigurationError: dispersion 'start' feeds 'orbit.gravity', which is no numeric "
        "parameter\n  numeric parameters: ballistic_coefficient, density, earth_angle0, j2, mu, "
        "r0_i, radius, rotation_rate, v0_i",
    ),
    "dispersion of two kinds": append(
        DISPERSION.replace('"orbit.r0_i"', '"orbit.r0_i", "orbit.v0_i"'),
        "ConfigurationError: dispersion 'start' feeds parameters of different kinds\n"
        "  orbit.r0_i  array (3,) [m]\n  orbit.v0_i  array (3,) [m/s]",
    ),
    "dispersion of wrong shape": append(
        DISPERSION.replace("10 m", "[1, 2] m"),
        "ConfigurationError: sigma of dispersion 'start' has shape (2,); it takes array (3,) [m]: "
        'write "[1.0, 1.0, 1.0] m"',
    ),
    "dispersion without a unit": append(
        DISPERSION.replace('"10 m"', "10.0"),
        "ConfigurationError: sigma of dispersion 'start' has no unit\n"
        '  it takes array (3,) [m]: write "[1.0, 1.0, 1.0] m"',
    ),
    "negative sigma": append(
        DISPERSION.replace("10 m", "-10 m"),
        "ConfigurationError: sigma of dispersion 'start' is [-10.0, -10.0, -10.0] m; "
        "it must be at least 0 m",
    ),
    "dispersion of unknown kind": append(
        DISPERSION + 'kind = "gaussian"\n',
        "ConfigurationError: dispersion 'start' is of kind 'gaussian'\n"
        "  kinds: list, log_uniform, multivariate, normal, truncated, uniform",
    ),
    "uniform dispersion with a sigma": append(
        DISPERSION + 'kind = "uniform"\n',
        "ConfigurationError: dispersion 'start' is uniform: it takes half_width, not sigma",
    ),
    "dispersion of what is no list": append(
        DISPERSION.replace('["orbit.r0_i"]', "3"),
        "ConfigurationError: dispersion 'start': to is 3, not a list of parameters\n"
        '  write to = ["orbit.r0_i"]',
    ),
    # ---------------------------------------------------------------- nested systems
    "nested file that is not there": append(
        '\n[component.nav]\ntype = "system"\nfile = "nav.toml"\n',
        "ConfigurationError: 'nav': there is no system file '{folder}/nav.toml'\n"
        "  system files there: system.toml",
    ),
    "system within itself": append(
        '\n[component.nav]\ntype = "system"\nfile = "system.toml"\n',
        "ConfigurationError: 'nav' is the system '{path}', which contains it\n  nest another file",
    ),
    "mistake in a nested system": append(
        '\n[component.nav]\ntype = "system"\nfile = "mount.toml"\n',
        "ConfigurationError: in 'nav' ({folder}/mount.toml): 'mount' has no parameter 'sigma'\n"
        "  its parameters: misalignment, misalignment_sigma0, misalignment_walk, offset, period, "
        "rate, times",
    ),
    "records of one name through nesting": append(
        '\n[component.nav]\ntype = "system"\nfile = "recorded.toml"\n'
        '\n[record.nav_mount]\nports = ["antenna.q_mu"]\n',
        "ConfigurationError: two records are called 'nav_mount', one of them in a nested system\n"
        "  rename one",
    ),
}  # fmt: skip

BESIDE = {
    "mount.toml": 'schema = "terrafix-system/1"\n'
    '[component.mount]\ntype = "antenna_mount"\nsigma = "1 deg"\n',
    "recorded.toml": 'schema = "terrafix-system/1"\n[component.mount]\ntype = "antenna_mount"\n'
    '[record.mount]\nports = ["mount.q_mu"]\n',
}


@pytest.fixture(scope="module", autouse=True)
def models_built_once():
    """Models do not depend on the mistakes: building them once saves half a minute."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (
            terrafix.components.truth.attitude,
            terrafix.components.sensors.imu,
            terrafix.components.filters.mekf,
            terrafix.components.truth.orbit,
            terrafix.components.sensors.sar,
        ):
            for name in [n for n in vars(module) if n.endswith("_model")]:
                patch.setattr(module, name, functools.cache(getattr(module, name)))
        yield


@pytest.fixture
def seed_mistake(tmp_path):
    """Write the open loop with a mistake in it."""

    def write(mistake: Mistake) -> Path:
        text = OPEN_LOOP
        for old, new in mistake.edits:
            assert old in text, "the mistake does not fit the example any more"
            text = text.replace(old, new, 1)
        path = tmp_path / "system.toml"
        path.write_text(text + mistake.more)
        for name, content in BESIDE.items():
            if name in mistake.more:
                (tmp_path / name).write_text(content)
        return path

    return write


def problems(path: Path, settings=()) -> list[str]:
    with pytest.raises(SystemCheckError) as caught:
        read_system(path, settings)
    return [f"{type(p).__name__}: {p}" for p in caught.value.problems]


@pytest.mark.parametrize("name", SYSTEM_MISTAKES)
def test_a_mistake_in_a_system_is_said_once_and_in_these_words(seed_mistake, name):
    mistake = SYSTEM_MISTAKES[name]
    path = seed_mistake(mistake)
    said = mistake.said.replace("{path}", str(path)).replace("{folder}", str(path.parent))
    assert problems(path, mistake.settings) == [said]
    assert not JARGON.search(said)


def test_the_system_without_mistakes_passes(seed_mistake):
    read_system(seed_mistake(Mistake("")))


# ------------------------------------------------------------------------- several at once

TOGETHER = (
    "wrong unit",
    "wrong choice",
    "float period",
    "unconnected input",
    "unknown port of the target",
    "unknown key",
    "misspelled parameter that is required",
    "record of an input",
    "negative sigma",
    "unknown type",
    "setting of an unknown component",
)


def test_mistakes_are_reported_together_and_none_for_what_follows(seed_mistake):
    """Eleven mistakes, eleven messages; what depends on the broken parts is not complained of."""
    chosen = [SYSTEM_MISTAKES[name] for name in TOGETHER if name != "unconnected input"]
    # the sensor of unknown type stays unconnected, so another input is left alone instead
    loose = edit(
        '    "antenna.q_mu -> sar.q_mu",\n',
        "",
        "WiringError: input 'sar.q_mu' is not connected and has no default\n"
        "  outputs of the same shape, unit and frame: 'antenna.q_mu'",
    )
    chosen.append(loose)
    path = seed_mistake(
        Mistake(
            "",
            tuple(e for m in chosen for e in m.edits),
            "".join(m.more for m in chosen),
        )
    )
    settings = [s for m in chosen for s in m.settings]
    assert sorted(problems(path, settings)) == sorted(m.said for m in chosen)
    with pytest.raises(SystemCheckError, match=f"has {len(TOGETHER)} problems"):
        read_system(path, settings)


@pytest.mark.parametrize("name", ["orbit", "attitude", "last_known", "predict", "correct", "sar"])
def test_a_component_that_cannot_be_made_is_one_mistake(seed_mistake, name):
    """Its connections, records and options are not also wrong."""
    begin = OPEN_LOOP.index(f"[component.{name}]")
    table = OPEN_LOOP[begin : OPEN_LOOP.index("\n\n", begin)]
    broken = re.sub(r'type = ".*"', 'type = "x1"', table)
    assert len(problems(seed_mistake(edit(table, broken, "")))) == 1


# ------------------------------------------------------------------------- files as a whole


def refusal(call, *arguments, **options) -> str:
    with pytest.raises(TerrafixError) as caught:
        call(*arguments, **options)
    text = f"{type(caught.value).__name__}: {caught.value}"
    assert not JARGON.search(text)
    return text


def test_files_that_are_no_systems_are_refused(tmp_path):
    system = tmp_path / "system.toml"
    system.write_text(OPEN_LOOP)
    assert refusal(read_system, tmp_path / "sytem.toml") == (
        f"ConfigurationError: there is no system file '{tmp_path}/sytem.toml'\n"
        "  did you mean 'system.toml'?"
    )
    assert refusal(read_system, tmp_path / "a" / "b.toml") == (
        f"ConfigurationError: there is no system file '{tmp_path}/a/b.toml'\n"
        f"  there is no folder '{tmp_path}/a' either"
    )
    assert refusal(read_system, tmp_path) == (
        f"ConfigurationError: '{tmp_path}' is a folder without SystemStructure.ssd; "
        "name a system file (.toml) in it"
    )
    system.write_bytes(b"\x89HDF\r\n\x1a\n\xff\xfe")
    assert refusal(read_system, system) == (
        f"ConfigurationError: '{system}' is no system file: it is not text in UTF-8\n"
        "  name a .toml file"
    )
    system.write_text(OPEN_LOOP.replace("[component.orbit]", "[component.orbit"))
    assert refusal(read_system, system) == (
        f"ConfigurationError: '{system}' is not TOML: Expected ']' at the end of a table "
        "declaration (at line 46, column 17)\n  line 46: [component.orbit"
    )
    system.write_text(OPEN_LOOP.replace("terrafix-system/1", "terrafix-system/2"))
    assert refusal(read_system, system) == (
        f"ConfigurationError: '{system}' has schema 'terrafix-system/2'; this version reads "
        "'terrafix-system/1'\n"
        "  read it with the version of terrafix that it was written for, or convert it"
    )
    system.write_text('schema = "terrafix-system/1"\nname = "empty"\n')
    assert problems(system) == [
        "ConfigurationError: the system has no components\n"
        "  add one: [component.NAME] with a type in its file, or add(...) in Python"
    ]
    system.write_text("")
    assert problems(system) == [
        f"ConfigurationError: '{system}' has no schema\n"
        '  write schema = "terrafix-system/1" first'
    ]


def test_data_files_that_cannot_be_used_are_refused(tmp_path):
    """Missing, damaged, a folder, unset variables: found when the system is read."""
    orbit = tmp_path / "orbit.toml"

    def attempt(file: str) -> str:
        orbit.write_text(
            'schema = "terrafix-system/1"\n[component.truth]\ntype = "recorded_orbit"\n'
            f'orbit_file = "{file}"\n'
        )
        (text,) = problems(orbit)
        assert not JARGON.search(text)
        return text

    hint = "\n  set truth.orbit_file, or TERRAFIX_DATA to the folder with the data"
    assert attempt("absent.EOF") == (
        f"ConfigurationError: 'truth' needs the orbit file '{tmp_path}/absent.EOF', "
        f"which is not there{hint}"
    )
    assert attempt(".") == (
        f"ConfigurationError: 'truth' needs the orbit file '{tmp_path}', which is a folder{hint}"
    )
    (tmp_path / "torn.EOF").write_text("<Earth_Explorer_File><List_of_OSVs>")
    assert attempt("torn.EOF") == (
        f"ConfigurationError: 'truth' cannot read its orbit file: {tmp_path}/torn.EOF: damaged or "
        f"truncated orbit file: no element found: line 1, column 35{hint}"
    )
    (tmp_path / "garbage.nc").write_bytes(b"garbage" * 100)
    assert attempt("garbage.nc") == (
        f"ConfigurationError: 'truth' cannot play its recording: '{tmp_path}/garbage.nc' is "
        "damaged or no NetCDF file\n"
        "  record the original in an earlier run, and name the result it was written to"
    )
    assert (
        attempt("") == "ConfigurationError: 'truth.orbit_file' is ''; it takes the path of a file"
    )
    assert attempt("${TERRAFIX_NOWHERE}/a.EOF") == (
        "ConfigurationError: 'truth.orbit_file' is '${TERRAFIX_NOWHERE}/a.EOF', but the "
        "environment variable TERRAFIX_NOWHERE is not set\n"
        "  set TERRAFIX_NOWHERE, or write ${TERRAFIX_NOWHERE:-fallback}"
    )


# ------------------------------------------------------------------------- how a run is asked for


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A small system that must not take a step."""
    path = tmp_path / "small.toml"
    path.write_text(
        'schema = "terrafix-system/1"\nduration = "10 s"\n'
        '[component.mount]\ntype = "antenna_mount"\nrate = "10 Hz"\n'
    )

    def write_checkpoint() -> Path:
        checkpoint = tmp_path / "small.ckpt"
        simulate(read_system(path), checkpoint=checkpoint, checkpoint_every="4", duration="5")
        return checkpoint

    def attempt(**options) -> str:
        with monkeypatch.context() as patch:
            patch.setattr(Master, "run_until", lambda *_: pytest.fail("it took a step"))
            return refusal(simulate, read_system(path), **options)

    attempt.path, attempt.write_checkpoint = path, write_checkpoint
    return attempt


def test_runs_that_cannot_be_are_refused(small, tmp_path):
    assert small(members=0) == "ConfigurationError: members is 0; an ensemble has at least 1"
    assert small(duration="-1 s") == "RateError: duration is -1 s; it must be positive"
    assert small(duration=0.5) == (
        'RateError: duration is 0.5, a binary fraction near 0.5\n  write "0.5" (exact) or "1/2"'
    )
    assert small(duration="10 ms") == (
        "RateError: duration is 0.01 s, shorter than the base step of 0.1 s\n  give a longer one"
    )
    assert small(checkpoint_every="0 s") == (
        "RateError: checkpoint interval is 0 s; it must be positive"
    )
    assert small(out=tmp_path / "nowhere" / "run.nc") == (
        f"ConfigurationError: cannot write '{tmp_path}/nowhere/run.nc': there is no folder "
        f"'{tmp_path}/nowhere'"
    )
    assert small(out=tmp_path) == (
        f"ConfigurationError: '{tmp_path}' is a folder; name a file in it"
    )


def test_checkpoints_that_do_not_belong_are_refused(small, tmp_path):
    absent = tmp_path / "absent.ckpt"
    assert small(resume=absent) == (
        f"CheckpointError: there is no checkpoint '{absent}'\n"
        "  write one with --checkpoint-every SECONDS"
    )
    absent.write_text("no checkpoint")
    assert small(resume=absent) == (
        f"CheckpointError: '{absent}' is damaged or no checkpoint\n"
        "  start the run again without --resume"
    )
    checkpoint = small.write_checkpoint()
    assert small(resume=checkpoint, seed=5) == (
        "CheckpointError: the checkpoint belongs to another seed: 0 there, 5 here\n"
        "  resume it with the seed it was made with"
    )
    assert small(resume=checkpoint, members=7) == (
        "CheckpointError: the checkpoint belongs to other members: [0] there, "
        "[0, 1, 2, 3, 4, 5, 6] here\n  resume it with the members it was made with"
    )
    assert small(resume=checkpoint, duration="1 s") == (
        "CheckpointError: the checkpoint is at t = 4 s, beyond the duration of 1 s\n"
        "  give a longer duration"
    )
    text = small.path.read_text()
    small.path.write_text(text + 'misalignment_sigma0 = "1 rad"\n')
    told = small(resume=checkpoint)
    assert told.startswith(
        "CheckpointError: the checkpoint was made with other components: 'mount' is\n"
    )
    assert told.endswith("\n  give the same system file and --set options")
    small.path.write_text(text.replace("duration", 'name = "other"\nduration', 1))
    assert small(resume=checkpoint) == (
        "CheckpointError: the checkpoint belongs to another system: 'small' there, 'other' here\n"
        "  resume it with the system it was made with"
    )


# ------------------------------------------------------------------------- the command line


@pytest.mark.parametrize("as_json", [False, True], ids=["text", "json"])
@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize(
    "name",
    [
        "wrong unit",
        "unknown port of the source",
        "float period",
        "loop of one",
        "setting of nothing",
        "negative sigma",
    ],
)
def test_the_command_line_refuses_with_status_2(seed_mistake, name, command, as_json):
    mistake = SYSTEM_MISTAKES[name]
    words = [command, str(seed_mistake(mistake))]
    for path, value in mistake.settings:
        words += ["--set", f"{path}={value}"]
    result = CliRunner().invoke(main, words + ["--json"] * as_json)
    assert result.exit_code == 2
    assert mistake.said in result.stderr
    assert not JARGON.search(result.stderr)
    if as_json:
        (told,) = json.loads(result.stdout)["problems"]
        assert f"{told['type']}: {told['message']}" == mistake.said
    else:
        assert result.stdout == ""


def test_options_that_are_malformed_are_refused_with_status_2(tmp_path):
    system = str(EXAMPLES / "orbit.toml")
    for words, text in {
        ("--set", "orbit.gravity"): "--set 'orbit.gravity' sets nothing\n  write --set PATH=VALUE",
        ("--out", "run.txt"): "--out 'run.txt' is no .nc file",
        ("--duration", "soon"): "duration is 'soon', which is not a time in seconds",
        ("--members", "0"): "0 is not in the range x>=1",
        ("--resume", "absent.ckpt"): "there is no checkpoint 'absent.ckpt'",
    }.items():
        result = CliRunner().invoke(main, ["run", system, *words])
        assert (result.exit_code, result.stdout) == (2, "")
        assert text in result.stderr
