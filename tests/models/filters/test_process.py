"""Processes: steps, transitions and noise against closed forms and differences."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from terrafix.models.filters.error_state import SIDES, ErrorState, rotation, vector
from terrafix.models.filters.process import Process, propagate
from terrafix.models.filters.spacecraft import STATE, spacecraft_process
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import from_rotation_vector, product, rotation_matrix


class Propagated:
    """Step, transition and noise of a process as functions of numbers."""

    def __init__(self, state, process):
        self.state = state
        self.values = {b.name: ca.SX.sym(b.name, b.value_size) for b in state}
        sizes = {**process.inputs, **process.named()}
        self.given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
        self.step, self.time = ca.SX.sym("step"), ca.SX.sym("time")
        made = propagate(state, process, self.values, self.given, self.step, self.time)
        symbols = [*self.values.values(), *self.given.values(), self.step, self.time]
        results = [*(made.values[n] for n in self.values), made.transition, made.spread]
        self.function = ca.Function("f", symbols, results)
        x, y, e = (
            *({n: ca.SX.sym(n, v.numel()) for n, v in self.values.items()} for _ in range(2)),
            ca.SX.sym("e", state.size),
        )
        self.retract = ca.Function("r", [*x.values(), e], [*state.retract(x, e).values()])
        self.difference = ca.Function(
            "d", [*x.values(), *y.values()], [ca.vertcat(state.difference(x, y))]
        )

    def __call__(self, values, given, step, time=0.0):
        numbers = [*(values[n] for n in self.values), *(given[n] for n in self.given)]
        *end, phi, Q = (np.array(a.full()) for a in self.function(*numbers, step, time))
        return {k: v[:, 0] for k, v in zip(self.values, end, strict=True)}, phi, Q

    def by_differences(self, values, given, step, scale):
        """Transition by central differences, through retraction and difference."""
        end = list(self(values, given, step)[0].values())
        columns = []
        for k, h in enumerate(scale):
            off = []
            for sign in (1, -1):
                start = self.retract(*values.values(), sign * h * np.eye(self.state.size)[k])
                start = start if isinstance(start, tuple) else (start,)
                start = dict(zip(self.values, start, strict=True))
                there = self(start, given, step)[0].values()
                off.append(np.array(self.difference(*there, *end).full())[:, 0])
            columns.append((off[0] - off[1]) / (2 * h))
        return np.stack(columns, axis=1)


def test_a_double_integrator_is_exact():
    """Of white acceleration of density q: q h^3 / 3, q h^2 / 2, q h."""
    state = ErrorState(vector("r", 1, unit="m"), vector("v", 1, unit="m/s"))
    process = Process(
        rates=lambda x, _, w, __: {"r": x["v"], "v": w["a"]}, noise={"a": ("density", 1)}
    )
    end, phi, Q = Propagated(state, process)({"r": 1.0, "v": 2.0}, {"density": 3.0}, 0.5)
    assert (end["r"], end["v"]) == (2.0, 2.0)
    np.testing.assert_allclose(phi, [[1, 0.5], [0, 1]], rtol=1e-15)
    np.testing.assert_allclose(Q, 3 * np.array([[0.5**3 / 3, 0.125], [0.125, 0.5]]), rtol=1e-15)


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_noise_is_van_loans_integral_to_the_order_that_is_stated(order):
    """Against the matrix exponential; the error of the series falls with the order plus one."""
    rng = np.random.default_rng(order)
    A, G = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    process = Process(
        rates=lambda x, _, w, __: {"x": ca.mtimes(A, x["x"]) + ca.mtimes(G, w["w"])},
        noise={"w": ("density", 2)},
        order=order,
    )
    step = Propagated(ErrorState(vector("x")), process)
    errors = []
    for h in (0.02, 0.01):
        block = np.block([[-A, 2.0 * G @ G.T], [np.zeros((3, 3)), A.T]]) * h
        whole = expm(block)
        right = whole[3:, 3:].T @ whole[:3, 3:]  # Van Loan, 1978
        errors.append(np.abs(step({"x": np.zeros(3)}, {"density": 2.0}, h)[2] - right).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order + 1, abs=0.2)


def test_blocks_that_drive_themselves_are_exact():
    """A walk spreads by q h; a Gauss-Markov process keeps its variance in any number of steps."""
    state = ErrorState(vector("walk", 2), vector("bias", 1))
    process = Process(walks={"walk": "density"}, decays={"bias": ("tau", "sigma")})
    step = Propagated(state, process)
    given = {"density": 3.0, "tau": 50.0, "sigma": 2.0}
    end, phi, Q = step({"walk": [1.0, 2.0], "bias": 4.0}, given, 10)
    assert end["walk"].tolist() == [1.0, 2.0]
    assert end["bias"] == pytest.approx(4 * np.exp(-0.2))
    np.testing.assert_allclose(np.diag(phi), [1, 1, np.exp(-0.2)], rtol=1e-15)
    assert np.diag(Q)[:2].tolist() == [30.0, 30.0]
    assert phi[2, 2] ** 2 * 4.0 + Q[2, 2] == pytest.approx(4.0, rel=1e-14)


@pytest.mark.parametrize("side", SIDES)
def test_a_turn_at_a_constant_rate_is_exact_on_either_side(side):
    """To the order of the integration; the error of a left one turns, that of a right one back."""
    state = ErrorState(rotation("q", side=side), vector("bias"))
    process = Process(
        rates=lambda x, u, w, _: {"q": u["omega"] - x["bias"] + w["n"]},
        noise={"n": ("density", 3)},
        walks={"bias": "walk"},
        inputs={"omega": 3},
    )
    step = Propagated(state, process)
    rng = np.random.default_rng(7)
    q, bias, omega = rng.normal(size=4), 0.1 * rng.normal(size=3), rng.normal(size=3)
    q /= np.linalg.norm(q)
    given = {"omega": omega, "density": 2e-4, "walk": 1e-6}
    end, phi, Q = step({"q": q, "bias": bias}, given, 0.1)
    theta = 0.1 * (omega - bias)
    turn = from_rotation_vector(ca.DM(theta))
    right = product(turn, ca.DM(q)) if side == "left" else product(ca.DM(q), turn)
    np.testing.assert_allclose(end["q"], np.array(right)[:, 0], atol=1e-14)
    x, y, z = theta
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(phi[:3, :3], expm(-cross if side == "left" else cross), atol=1e-13)
    numeric = step.by_differences({"q": q, "bias": bias}, given, 0.1, np.full(6, 1e-5))
    np.testing.assert_allclose(phi, numeric, atol=1e-9)
    np.testing.assert_allclose(np.diag(Q), [2e-5] * 3 + [1e-7] * 3, rtol=1e-12)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("trial", range(10))
def test_a_derived_transition_is_the_difference_of_steps_at_random_states(side, trial):
    """Of a thrust along axes that turn, a pull, a drag and a bias of the rate: to 1e-6."""
    rng = np.random.default_rng(trial)
    state = ErrorState(vector("r"), vector("v"), rotation("q", side=side), vector("bias"))

    def rates(x, given, _, t):
        thrust = rotation_matrix(x["q"]).T @ given["thrust"]
        pull = -x["r"] / ca.norm_2(x["r"]) ** 3
        drag = -0.1 * ca.norm_2(x["v"]) * x["v"]
        return {"r": x["v"], "v": pull + drag + thrust, "q": given["rate"] - x["bias"]}

    process = Process(
        rates=rates, decays={"bias": ("tau", "sigma")}, inputs={"thrust": 3, "rate": 3}
    )
    step = Propagated(state, process)
    values = {n: rng.normal(size=3) for n in ("r", "v", "bias")}
    values["r"] *= 2 / np.linalg.norm(values["r"])
    q = rng.normal(size=4)
    values = {"r": values["r"], "v": values["v"], "q": q / np.linalg.norm(q)} | {
        "bias": values["bias"]
    }
    given = {"thrust": rng.normal(size=3), "rate": 2 * rng.normal(size=3), "tau": 3.0, "sigma": 1.0}
    phi = step(values, given, 0.3)[1]
    numeric = step.by_differences(values, given, 0.3, np.full(12, 1e-5))
    np.testing.assert_allclose(phi, numeric, rtol=1e-6, atol=1e-6 * np.abs(phi).max())
    assert np.abs(phi[3:6, 6:9]).max() > 0.05  # the thrust turns with the axes


@pytest.mark.parametrize("side", SIDES)
def test_integration_is_of_order_four_on_either_side(side):
    """Of a rate that turns itself: halving the step leaves a sixteenth of the error."""
    state = ErrorState(rotation("q", side=side))

    def rates(x, _, __, t):
        return {"q": ca.vertcat(ca.cos(3 * t), ca.sin(2 * t), x["q"][0])}

    step = Propagated(state, Process(rates=rates))

    def flown(n):
        values, h = {"q": np.array([0.0, 0, 0, 1])}, 1.0 / n
        for k in range(n):
            values = step(values, {}, h, (k + 1) * h)[0]
        return values["q"]

    right = flown(256)
    errors = [np.abs(flown(n) - right).max() for n in (8, 16)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)


@pytest.mark.parametrize("gravity", ["j2", "two-body"])
def test_the_spacecraft_s_closed_form_is_the_derivative_of_its_step(gravity, start_e):
    """Derived and by differences; the closed form leaves out 1e-12 and what a step turns."""
    r, v, _ = start_e
    rng = np.random.default_rng(5)
    q = rng.normal(size=4)
    values = {"r_e": r, "v_e": v, "q_mu": np.array([1e-3, -2e-3, 1e-3, 1.0])}
    values["q_mu"] /= np.linalg.norm(values["q_mu"])
    given = {
        "delta_v_b": 1e-3 * rng.normal(size=3),
        "q_be": q / np.linalg.norm(q),
        "mu": EARTH.mu,
        "radius": EARTH.radius,
        "j2": EARTH.j2,
        "rotation_rate": EARTH.rotation_rate,
        "accel_psd": 1e-8,
        "misalignment_psd": 1e-12,
    }
    derived = Propagated(STATE, spacecraft_process(gravity, "derived"))
    closed = Propagated(STATE, spacecraft_process(gravity))
    scale = np.repeat([10.0, 0.01, 1e-4], 3)
    a, b = (step(values, given, 0.1)[1] for step in (derived, closed))
    size = np.outer(scale, 1 / scale)  # in units of what each element may be
    assert np.abs((a - b) / size).max() < 1e-9
    numeric = derived.by_differences(values, given, 0.1, scale)
    assert np.abs((a - numeric) / size).max() < 1e-6


@pytest.mark.parametrize(
    ("state", "process", "said"),
    [
        (
            ErrorState(vector("a")),
            lambda: Process(rates=lambda *_: {"b": 0}, step=lambda *_: {}),
            "continuous .* or discrete .*, not both",
        ),
        (ErrorState(vector("a")), lambda: Process(noise={"w": ("q", 1)}), "noise w has no rates"),
        (
            ErrorState(vector("a")),
            lambda: Process(walks={"b": "q"}),
            "names 'b' in walks, which is no block; the blocks are a",
        ),
        (
            ErrorState(vector("a")),
            lambda: Process(walks={"a": "q"}, decays={"a": ("t", "s")}),
            "'a' is a walk and a Gauss-Markov process",
        ),
        (
            ErrorState(vector("a")),
            lambda: Process(rates=lambda *_: {"b": ca.SX.zeros(3)}),
            "moves 'b', which is no block",
        ),
        (
            ErrorState(vector("a")),
            lambda: Process(rates=lambda *_: {"a": ca.SX.zeros(2)}),
            r"by a rate of shape \(2, 1\); its error has 3 elements",
        ),
        (
            ErrorState(vector("a")),
            lambda: Process(rates=lambda *_: {"a": ca.SX.zeros(3)}, walks={"a": "q"}),
            "is moved by the process, and drives itself",
        ),
    ],
)
def test_what_is_no_process_is_refused(state, process, said):
    with pytest.raises(ValueError, match=said):
        Propagated(state, process())
