"""Where the instances of an FMU live: in this process, in another, or in one each."""

from __future__ import annotations

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import TerrafixError
from terrafix.cosim.exchange.fmi.run.apart import Disturbance
from terrafix.cosim.exchange.fmi.run.binding import was_instantiated
from terrafix.cosim.exchange.fmi.run.fleet import Fleet, Setup
from terrafix.cosim.exchange.fmi.run.reading import Interface
from terrafix.cosim.exchange.fmi.run.remote import FIRST_LIMIT, MODULE, RemoteFleet, Worker

AnyFleet = Fleet | RemoteFleet
_APART = "each member has a process of its own"
_known: dict[tuple[str, str], Disturbance | None] = {}


def make_fleet(
    interface: Interface,
    setup: Setup,
    inputs: FloatArray,
    h: float,
    *,
    isolate: bool = False,
    limit: float = FIRST_LIMIT,
) -> tuple[AnyFleet, str]:
    """Make a fleet where its instances do not disturb each other, and say what is unusual.

    An FMU that says that it can be instantiated once in a process, or shows it in a self-test, gets
    a process for each member. The self-test is made where a second instance is wanted: for
    ensembles, and for an FMU that this process has had before. Those of terrafix have no static
    data.

    Parameters
    ----------
    interface : Interface
    setup : Setup
    inputs : ndarray, shape (n_members, width)
        Start values, for the self-test.
    h : float
        Step of the self-test [s].
    isolate : bool
    limit : float
        Longest answer of another process [s].
    """
    n_members = len(inputs)
    if interface.once:
        note = f"'{setup.file}' says that it can be instantiated once in a process: {_APART}"
        return RemoteFleet(setup, n_members, limit, apart=True), note
    second = n_members > 1 or (not isolate and was_instantiated(interface.archive, setup.kind))
    found = _self_test(interface, setup, inputs, h) if second and not interface.own else None
    if found is not None:
        how = f"{_name(interface, setup, found.column)} is {found.alone!r} alone, {found.beside!r}"
        how = f"{how} beside another" if found.column >= 0 else found.said
        note = f"instances of '{setup.file}' disturb each other in one process ({how}): {_APART}"
        return RemoteFleet(setup, n_members, limit, apart=True), note
    return (RemoteFleet(setup, n_members, limit) if isolate else Fleet(setup, n_members)), ""


def _self_test(
    interface: Interface, setup: Setup, inputs: FloatArray, h: float
) -> Disturbance | None:
    key = (str(interface.archive.folder), setup.kind)
    if key not in _known:
        rows: list[int] = (np.arange(2) % len(inputs)).tolist()
        worker = Worker(MODULE, f"the FMU '{setup.file}'")
        try:
            _known[key] = worker.call(
                "rehearse", setup.of(rows), inputs[rows], h, FIRST_LIMIT,
                limit=3 * FIRST_LIMIT,
            )  # fmt: skip
        except TerrafixError:
            _known[key] = None  # it fails alone: the run will say so
        finally:
            worker.close()
    return _known[key]


def _name(interface: Interface, setup: Setup, column: int) -> str:
    """Name of the variable in a column of the outputs."""
    names = {}
    for port in interface.ports:
        for quantity, _ in port.fields.values():
            for name, reference in zip(quantity.scalars(), quantity.references, strict=False):
                names[quantity.kind, reference] = name
    for group in setup.outputs:
        place = column - group.start
        if 0 <= place < len(group.references):
            return names.get((group.kind, group.references[place]), "an output")
    return "an output"
