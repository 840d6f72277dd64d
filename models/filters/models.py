r"""The two models that every filter is: predict, and correct, made of what it estimates; its twins.

`predict_model` keeps the estimate, moves it by the process, and begins anew where a posterior
comes, or where it is told to start again; `correct_model` weighs a prior against a fix. Late in a
chain of corrections a model is told by `earlier` that the estimate it reads was corrected before
it, so that its own is the posterior even where it has no fix.

The twins are what a filter believes, made true: `truth_model` draws a start and the noise of the
process, `sensor_model` measures as an observation says. Against them a filter is consistent, or not
made right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import pi
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.core.symmetric import mirrored, semidefinite_root
from terrafix.models.filters.error_state import AGE, ErrorState
from terrafix.models.filters.measurement import TIME, Observation, corrected
from terrafix.models.filters.process import Process, propagate
from terrafix.models.filters.robust import THRESHOLDS, robust_rule
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
    smoothed: bool = False,
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
    smoothed : bool
        Put out besides what a smoother needs: the transition of the error since the posterior that
        the estimate began with, or the start.
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
        ``restart.*`` likewise, and the flag ``restart.fresh``. Outputs ``prior.*``;
        ``error_transition`` (n, n) and the time ``transition_since`` [s], if `smoothed`.

    Raises
    ------
    ValueError
        If a block is neither told nor has a sigma, or both, or does not exist; or it restarts
        and no block is told.
    """
    _check_start(name, state, told, sigmas, restarts)
    inputs = {key: ca.SX.sym(key, size) for key, size in process.inputs.items()}
    parameters = {key: ca.SX.sym(key, size) for key, size in process.named().items()}
    own, posterior = state.symbols("own"), state.symbols("posterior")
    fresh, step, time = (ca.SX.sym(key) for key in ("posterior_fresh", "dt", "time"))
    begin = {key: ca.if_else(fresh > 0.5, posterior[key], own[key]) for key in own}
    # one that the process knows as well is the same: a stationary Gauss-Markov process's
    sigma = {key: parameters.get(key, ca.SX.sym(key)) for key in sigmas.values()}
    own_sigma = {block: sigma[key] for block, key in sigmas.items()}
    start, initial = _start("start", state, told, own_sigma)
    given_up = ca.SX(0)
    if restarts:
        again, anew = _start("restart", state, told, own_sigma)
        given_up = ca.SX.sym("restart_fresh")
        start |= {"restart.fresh": given_up} | again
        begin = {key: ca.if_else(given_up > 0.5, anew[key], begin[key]) for key in begin}
    marks = {instant: ca.SX.sym(f"{instant}_fresh") for instant in state.instants}
    gone = ca.SX.sym("transition", state.size, state.size)
    phi = ca.if_else(ca.fmax(fresh, given_up) > 0.5, ca.SX.eye(state.size), gone)
    for instant, mark in marks.items():
        made = state.cloned(begin, instant, time - step)
        begin = {key: ca.if_else(mark > 0.5, made[key], begin[key]) for key in begin}
        phi = ca.if_else(mark > 0.5, ca.mtimes(state.cloning(instant), phi), phi)
    moved = propagate(state, process, begin, {**inputs, **parameters}, step, time)
    following = {**begin, **moved.values, "P": moved.covariance(begin["P"])}
    if state.carried:
        following[AGE] = begin[AGE] + step
    states = dict(own)
    outputs = {f"prior.{key}": symbol for key, symbol in own.items()}
    if smoothed:
        since = ca.SX.sym("since")
        following["error_transition"] = ca.mtimes(moved.transition, phi)
        # nothing before a start anew is smoothed: what was estimated then was given up
        begun = ca.if_else(fresh > 0.5, time - step, since)
        following["transition_since"] = ca.if_else(given_up > 0.5, NEVER, begun)
        initial["error_transition"] = ca.densify(ca.SX.eye(state.size))
        carried = {"error_transition": gone, "transition_since": since}
        states |= carried
        outputs |= carried
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
        states=states,
        parameters={**parameters, **sigma},
        next=following,
        initial=initial,
        outputs=outputs,
        step=step,
        time=time if uses_time else None,
    )


def _check_start(
    name: str, state: ErrorState, told: Sequence[str], sigmas: Mapping[str, str], restarts: bool
) -> None:
    """Raise ValueError where a start, or one anew, is not said as `predict_model` takes it."""
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
    if restarts and not told:
        raise ValueError(
            f"filter '{name}' restarts, and no block is told: name in `told` what a start message "
            "says"
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
    never = {time: ca.SX(0 if time == AGE else NEVER) for time in state.times}
    return start, {**initial, **never, "P": ca.densify(P)}


def correct_model(
    name: str,
    state: ErrorState,
    observation: Observation,
    update: str = "ekf",
    *,
    weights: str = "none",
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
    weights : {"none", "huber", "nis"}
        How it is made robust, see `terrafix.models.filters.robust`: take the parameter
        ``huber_threshold`` [sigma], or ``nis_threshold`` (m,), the largest normalized innovation
        squared with 1 to m elements that is taken as it is.
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
        ``fix.t`` [s], in its place the field `Observation.valid_at` if there is one, which must be
        that of the prior, or of its clone; those of the observation. Parameters
        ``gate`` (m,), the largest normalized innovation squared accepted with 1 to m elements
        (infinity: all), and those of the observation. Outputs ``estimate.*``: the posterior where
        there is one, else the prior; ``posterior.*``, the same and ``posterior.valid``;
        ``innovation.residual`` (m,), ``.sigma`` (m,), ``.nis``, ``.dof``, the number of elements
        present, ``.accepted``, ``.valid``, and ``.reason``, an index into
        `terrafix.models.filters.measurement.REASONS`. Residual and sigma are zero and one for
        absent elements and without a fix; the normalized innovation squared is that of the
        covariance without underweighting and robust weights.

    Raises
    ------
    ValueError
        If the update or the weights are not known, or the observation does not fit the error state.
    """
    prior, fix = state.symbols("prior"), observation.symbols("fix")
    fresh, fix_t, time = (ca.SX.sym(key) for key in ("fix_fresh", "fix_t", "time"))
    inputs = {key: ca.SX.sym(key, size) for key, size in observation.inputs.items()}
    parameters = {key: ca.SX.sym(key, size) for key, size in observation.parameters.items()}
    gate = ca.SX.sym("gate", observation.size)
    thresholds = {}
    if weights in THRESHOLDS:
        size = observation.size if weights == "nis" else 1
        thresholds = {THRESHOLDS[weights]: ca.SX.sym(THRESHOLDS[weights], size)}
    rule = robust_rule(update_rule(update), weights, *thresholds.values())
    messages = {
        **{f"prior.{key}": symbol for key, symbol in prior.items()},
        **{f"fix.{key}": symbol for key, symbol in fix.items()},
        "fix.fresh": fresh,
        **({} if observation.valid_at else {"fix.t": fix_t}),
    }
    counted, beta, n_updates = {}, ca.SX(0), ca.SX.sym("n_updates")
    if underweighting:
        counted = {k: ca.SX.sym(k) for k in ("underweighting", "underweighted_updates")}
        beta = ca.if_else(
            n_updates <= counted["underweighted_updates"], counted["underweighting"], 0.0
        )
    arrived = fresh > 0.5
    fix["present"] = ca.if_else(arrived, fix["present"], 0.0)
    of = fix[observation.valid_at] if observation.valid_at else fix_t
    measurement = observation.about(state, prior, fix, {**inputs, **parameters, TIME: of})
    outcome = corrected(
        state,
        prior,
        altered(measurement) if altered else measurement,
        rule,
        gate=gate,
        beta=beta,
        lateness=of - (prior[f"t_{observation.instant}"] if observation.instant else time),
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
        parameters={**parameters, **counted, **thresholds, "gate": gate},
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


def truth_model(
    name: str,
    state: ErrorState,
    process: Process,
    *,
    told: Sequence[str],
    sigmas: Mapping[str, str],
) -> Model:
    """A truth that is what a filter of these believes: its start, and noise as it moves, drawn.

    Parameters are those of `predict_model`. The start of a block that is told is drawn about it.

    Returns
    -------
    Model
        Inputs of the process; for the start alone ``start.*``. Outputs by block, without clones.
    """
    present = state.present
    inputs = {key: ca.SX.sym(key, size) for key, size in process.inputs.items()}
    parameters = {key: ca.SX.sym(key, size) for key, size in process.named().items()}
    values = {b.name: ca.SX.sym(f"own_{b.name}", b.value_size) for b in present}
    step, time = ca.SX.sym("dt"), ca.SX.sym("time")
    first, noise = (ca.SX.sym(key, present.size) for key in ("first", "noise"))
    moved = propagate(present, process, values, {**inputs, **parameters}, step, time)
    end = present.retract(moved.values, ca.mtimes(semidefinite_root(moved.spread), noise))
    sigma = {key: parameters.get(key, ca.SX.sym(key)) for key in sigmas.values()}
    start, initial = _start(
        "start", present, told, {block: sigma[key] for block, key in sigmas.items()}
    )
    begin = present.retract(initial, ca.mtimes(semidefinite_root(initial["P"]), first))
    following = present.normalized(end)
    free = ca.symvar(ca.vertcat(*following.values()))
    uses_time = time.element_hash() in {element.element_hash() for element in free}
    return Model(
        name,
        inputs={**inputs, **start},
        states=values,
        parameters={**parameters, **sigma},
        noise={"first": first, "noise": noise},
        next=following,
        initial=present.normalized(begin),
        outputs=values,
        step=step,
        time=time if uses_time else None,
    )


def sensor_model(name: str, state: ErrorState, observation: Observation) -> Model:
    """A sensor that measures what an observation says, with white noise, and reports it.

    Returns
    -------
    Model
        Inputs: the true values of blocks, the observation's inputs, and the fields of its message.
        Parameters ``sigma`` (m,), and those of the observation. Output ``fix.*``.

    Raises
    ------
    ValueError
        If the observation is of an instant that is past, or maps the error of a field.
    """
    if observation.instant or observation.mapped or observation.of_ensembles:
        what = (
            f"is of the instant '{observation.instant}'"
            if observation.instant
            else "maps the error of a field"
            if observation.mapped
            else "is a function of ensembles"
        )
        raise ValueError(
            f"the observation of sensor '{name}' {what}: such a sensor is a component of its own"
        )
    values = {b.name: ca.SX.sym(b.name, b.value_size) for b in state.present}
    sizes = {b.name: b.size for b in observation.fields} | dict(observation.inputs)
    inputs = {key: ca.SX.sym(key, size) for key, size in sizes.items()}
    parameters = {key: ca.SX.sym(key, size) for key, size in observation.parameters.items()}
    sigma, noise = (ca.SX.sym(key, observation.size) for key in ("sigma", "noise"))
    time = ca.SX.sym("time")
    y = ca.SX(observation.predict(values, {**inputs, **parameters, TIME: time})) + sigma * noise
    for k in observation.angular:
        y[k] -= 2 * pi * ca.floor((y[k] + pi) / (2 * pi))
    free = {e.element_hash() for e in ca.symvar(y)}
    used = {
        k: s
        for k, s in values.items()
        if any(s[i].element_hash() in free for i in range(s.numel()))
    }
    return Model(
        name,
        inputs={**used, **inputs},
        parameters={**parameters, "sigma": sigma},
        noise={"noise": noise},
        outputs={
            "fix.y": y,
            **{f"fix.{b.name}": inputs[b.name] for b in observation.fields},
            "fix.R": ca.densify(ca.diag(sigma**2)),
            "fix.present": ca.SX.ones(observation.size),
            "fix.valid": ca.SX(1),
        },
        time=time if time.element_hash() in free else None,
    )
