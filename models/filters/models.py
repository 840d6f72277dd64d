r"""The two models that every filter is: predict, and correct, made of what it estimates.

`predict_model` keeps the estimate, moves it by the process, and begins anew where a posterior
comes, or where it is told to start again; `correct_model` weighs a prior against a fix. Late in a
chain of corrections a model is told by `earlier` that the estimate it reads was corrected before
it, so that its own is the posterior even where it has no fix.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.core.symmetric import mirrored
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.measurement import Observation, corrected
from terrafix.models.filters.process import Process, propagate
from terrafix.models.filters.updates import Measurement, update_rule

NEVER = -1e12
"""Time of a clone that was not made yet [s]."""


def predict_model(
    name: str,
    state: ErrorState,
    process: Process,
    *,
    told: Sequence[str],
    sigmas: Mapping[str, str],
    restarts: bool = False,
) -> Model:
    """The estimate between fixes, and the covariance of its error.

    Parameters
    ----------
    name : str
        Of the model.
    state : ErrorState
    process : Process
    told : sequence of str
        Blocks that the start message tells, in the order of the blocks; its ``P`` is of these.
    sigmas : mapping of str to str
        Of the other blocks, which start at zero (no rotation): the parameter that holds the sigma
        of each of their elements.
    restarts : bool
        Take ``restart.*``, a start message of a later instant. Where it is fresh, the step begins
        as the filter does at t = 0: blocks told are those of the message, with its ``P``; the
        others are zero (no rotation) with their sigma, and no covariance with any block remains;
        clones are as if never made, unless their instant is this one. A posterior of the same
        instant is not taken: it corrects what is given up.

    Returns
    -------
    Model
        Inputs of the process; ``posterior.*`` and the flag ``posterior.fresh``, which makes the
        step begin there; ``INSTANT.fresh``, which makes its clones anew at the start of the step;
        for the start alone ``start.*`` of the blocks told, and ``start.P``; where it restarts,
        ``restart.*`` likewise, and the flag ``restart.fresh``. Outputs ``prior.*``.

    Raises
    ------
    ValueError
        If a block is neither told nor has a sigma, or both, or does not exist; or it restarts
        and no block is told.
    """
    names = [block.name for block in state]
    for block in [*told, *sigmas]:
        if block not in names:
            raise ValueError(
                f"filter '{name}' starts '{block}', which is no block; the blocks are "
                f"{', '.join(names)}"
            )
    for block in (block.name for block in state if not block.clone_of):
        if (block in told) == (block in sigmas):
            raise ValueError(
                f"block '{block}' of filter '{name}' starts from a message or from a sigma: "
                "say one of them"
            )
    inputs = {key: ca.SX.sym(key, size) for key, size in process.inputs.items()}
    parameters = {key: ca.SX.sym(key, size) for key, size in process.named().items()}
    own, posterior = state.symbols("own"), state.symbols("posterior")
    fresh, step, time = (ca.SX.sym(key) for key in ("posterior_fresh", "dt", "time"))
    begin = {key: ca.if_else(fresh > 0.5, posterior[key], own[key]) for key in own}
    # one that the process knows as well is the same: a stationary Gauss-Markov process's
    sigma = {key: parameters.get(key, ca.SX.sym(key)) for key in sigmas.values()}
    own_sigma = {block: sigma[key] for block, key in sigmas.items()}
    start, initial = _start("start", state, told, own_sigma)
    if restarts:
        if not told:
            raise ValueError(
                f"filter '{name}' restarts, and no block is told: name in `told` what a start "
                "message says"
            )
        again, anew = _start("restart", state, told, own_sigma)
        afresh = start["restart.fresh"] = ca.SX.sym("restart_fresh")
        start |= again
        begin = {key: ca.if_else(afresh > 0.5, anew[key], begin[key]) for key in begin}
    marks = {instant: ca.SX.sym(f"{instant}_fresh") for instant in state.instants}
    for instant, mark in marks.items():
        made = state.cloned(begin, instant, time - step)
        begin = {key: ca.if_else(mark > 0.5, made[key], begin[key]) for key in begin}
    moved = propagate(state, process, begin, {**inputs, **parameters}, step, time)
    following = {**begin, **moved.values, "P": moved.covariance(begin["P"])}
    free = ca.symvar(ca.vertcat(*(ca.vec(ca.SX(value)) for value in following.values())))
    uses_time = time.element_hash() in {element.element_hash() for element in free}
    return Model(
        name,
        inputs={
            **inputs,
            **{f"posterior.{key}": symbol for key, symbol in posterior.items()},
            "posterior.fresh": fresh,
            **{f"{instant}.fresh": mark for instant, mark in marks.items()},
            **start,
        },
        states=own,
        parameters={**parameters, **sigma},
        next=following,
        initial=initial,
        outputs={f"prior.{key}": symbol for key, symbol in own.items()},
        step=step,
        time=time if uses_time else None,
    )


def _start(
    head: str, state: ErrorState, told: Sequence[str], sigmas: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Inputs of a start message, and the estimate that they make."""
    blocks = [block for block in state if block.name in told]
    size = sum(block.size for block in blocks)
    start = {f"{head}.{b.name}": ca.SX.sym(f"{head}_{b.name}", b.value_size) for b in blocks}
    P = ca.SX(state.size, state.size)
    if blocks:
        start[f"{head}.P"] = ca.SX.sym(f"{head}_P", size, size)
        at, whole = 0, mirrored(start[f"{head}.P"])
        rows: list[tuple[slice, slice]] = []
        for block in blocks:
            place = state.places[block.name]
            rows.append((slice(at, at + block.size), slice(place.start, place.stop)))
            at += block.size
        for a, own in rows:
            for b, other in rows:
                P[own, other] = whole[a, b]
    for name, sigma in sigmas.items():
        for k in range(state.places[name].start, state.places[name].stop):
            P[k, k] = sigma**2
    initial = {b.name: start.get(f"{head}.{b.name}", b.start()) for b in state}
    for block in state:
        if block.clone_of:
            initial[block.name] = initial[block.clone_of]
    never = {f"t_{instant}": ca.SX(NEVER) for instant in state.instants}
    return start, {**initial, **never, "P": ca.densify(P)}


def correct_model(
    name: str,
    state: ErrorState,
    observation: Observation,
    update: str = "ekf",
    *,
    underweighting: bool = True,
    chained: bool = False,
    recentered: bool = True,
    altered: Callable[[Measurement], Measurement] | None = None,
) -> Model:
    """Correction of the prior by a fix: update, underweighting, gate.

    Parameters
    ----------
    name : str
        Of the model.
    state : ErrorState
    observation : Observation
    update : {"ekf", "iterated", "unscented"}
        How the measurement is weighed.
    underweighting : bool
        Take ``underweighting``, the factor applied to the first ``underweighted_updates`` fixes,
        accepted or not.
    chained : bool
        Read from ``earlier.fresh`` whether the prior was corrected in this tick already.
    recentered : bool
        Express the covariance about the posterior.
    altered : callable, optional
        Changes the measurement: for negative controls.

    Returns
    -------
    Model
        Inputs ``prior.*``; ``fix.*``, as `Observation.shapes` has it, ``fix.fresh`` and the time
        ``fix.t`` [s], which must be that of the prior; those of the observation. Parameters
        ``gate`` (m,), the largest normalized innovation squared accepted with 1 to m elements
        (infinity: all), and those of the observation. Outputs ``estimate.*``: the posterior where
        there is one, else the prior; ``posterior.*``, the same and ``posterior.valid``;
        ``innovation.residual`` (m,), ``.sigma`` (m,), ``.nis``, ``.dof``, the number of elements
        present, ``.accepted``, ``.valid``, and ``.reason``, an index into
        `terrafix.models.filters.measurement.REASONS`. Residual and sigma are zero and one for
        absent elements and without a fix; the normalized innovation squared is that of the
        covariance without underweighting.

    Raises
    ------
    ValueError
        If the update is not known, or the observation does not fit the error state.
    """
    rule = update_rule(update)
    prior, fix = state.symbols("prior"), observation.symbols("fix")
    fresh, fix_t, time = (ca.SX.sym(key) for key in ("fix_fresh", "fix_t", "time"))
    inputs = {key: ca.SX.sym(key, size) for key, size in observation.inputs.items()}
    parameters = {key: ca.SX.sym(key, size) for key, size in observation.parameters.items()}
    gate = ca.SX.sym("gate", observation.size)
    messages = {
        **{f"prior.{key}": symbol for key, symbol in prior.items()},
        **{f"fix.{key}": symbol for key, symbol in fix.items()},
        "fix.fresh": fresh,
        "fix.t": fix_t,
    }
    counted, beta, n_updates = {}, ca.SX(0), ca.SX.sym("n_updates")
    if underweighting:
        counted = {k: ca.SX.sym(k) for k in ("underweighting", "underweighted_updates")}
        beta = ca.if_else(
            n_updates <= counted["underweighted_updates"], counted["underweighting"], 0.0
        )
    arrived = fresh > 0.5
    fix["present"] = ca.if_else(arrived, fix["present"], 0.0)
    measurement = observation.about(state, prior, fix, {**inputs, **parameters})
    outcome = corrected(
        state,
        prior,
        altered(measurement) if altered else measurement,
        rule,
        gate=gate,
        beta=beta,
        lateness=fix_t - (prior[f"t_{observation.instant}"] if observation.instant else time),
        recentered=recentered,
    )
    accepted = ca.logic_and(arrived, outcome.accepted)
    valid = accepted
    if chained:
        messages["earlier.fresh"] = ca.SX.sym("earlier_fresh")
        valid = ca.logic_or(accepted, messages["earlier.fresh"] > 0.5)
    states = {"n_updates": n_updates} if underweighting else {}
    return Model(
        name,
        inputs={**messages, **inputs, **observation.answers()},
        states=states,
        parameters={**parameters, **counted, "gate": gate},
        next={"n_updates": n_updates + arrived} if states else {},
        initial={"n_updates": ca.if_else(arrived, 1.0, 0.0)} if states else {},
        outputs={
            **{f"estimate.{key}": value for key, value in outcome.values.items()},
            **{f"posterior.{key}": value for key, value in outcome.values.items()},
            "posterior.valid": valid,
            "innovation.residual": outcome.update.residual,
            "innovation.sigma": ca.sqrt(ca.fmax(ca.diag(outcome.update.S), 0.0)),
            "innovation.nis": outcome.update.nis,
            "innovation.dof": outcome.dof,
            "innovation.accepted": accepted,
            "innovation.valid": arrived,
            "innovation.reason": outcome.reason,
        },
        time=time,
    )
