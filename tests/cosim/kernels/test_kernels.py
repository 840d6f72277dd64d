"""Ensemble kernels: against NumPy, against one another, failing members, cache, compilers."""

import ctypes
import itertools
import os
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import terrafix as tf
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.noise import NormalStream, normal_quantile, stream_key
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.build import (
    Argument,
    Result,
    Specification,
    build_kernel,
    build_kernels,
)
from terrafix.cosim.kernels.compiled import kernel_source
from terrafix.cosim.kernels.virtual import VirtualMachineKernel

DT = 0.125
KEY = stream_key(7, "walk", "w")
SIZES = [1, 7, 100]

needs_compiler = pytest.mark.skipif(
    not any(toolchain._identify(command) for command in toolchain._commands()),
    reason="no C compiler",
)
COMPILED = [pytest.param(kind, marks=needs_compiler) for kind in ("vector", "c")]
both = pytest.mark.parametrize("kind", [*COMPILED, "vm"])
compiled = pytest.mark.parametrize("kind", COMPILED)


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def environment(monkeypatch, cache):
    """A cache of these tests alone, nothing known of any compiler, and no wish of the user's."""
    monkeypatch.setenv("TERRAFIX_CACHE", str(cache))
    monkeypatch.delenv("TERRAFIX_KERNEL", raising=False)
    monkeypatch.setattr(toolchain, "_defects", {})


def walk() -> Specification:
    """A random walk with a gain per member: arithmetic and square roots only."""
    x, w, gain, dt = (ca.SX.sym(n, k) for n, k in (("x", 3), ("w", 3), ("gain", 1), ("dt", 1)))
    following = x + gain * ca.sqrt(dt) * w
    distance = ca.sqrt(ca.sumsqr(following))
    function = ca.Function("walk_step", [x, w, gain, dt], [distance, following], {"cse": True})
    arguments = [
        Argument("x", 3, "array"),
        Argument("w", 3, "noise"),
        Argument("gain", 1, "array"),
        Argument("dt", 1, "shared"),
    ]
    return Specification(function, arguments, [Result("distance", 1), Result("x", 3)])


def build(kind: str, specification: Specification, monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", kind)
    kernel = build_kernel(*specification)
    monkeypatch.delenv("TERRAFIX_KERNEL")
    assert kernel.kind == kind
    return kernel


class Walkers:
    """The arrays of an ensemble of walks, and the kernel bound to them."""

    def __init__(self, kernel, members, x=None) -> None:
        self.members = np.asarray(members, dtype=np.int64)
        n = len(self.members)
        self.x = np.zeros((n, 3)) if x is None else x
        self.x[:] = self.members[:, None] / 8
        self.gain = 1 + self.members / 16
        self.dt = np.array([DT])
        self.distance = np.full(n, -1.0)
        self.active = np.ones(n, dtype=bool)
        self.failed = np.zeros(n, dtype=np.uint8)
        self.call = kernel.bind(
            n,
            {"x": self.x, "gain": self.gain, "dt": self.dt},
            {"distance": self.distance, "x": self.x},
            members=self.members,
            noise_keys={"w": KEY},
            active=self.active,
            failed=self.failed,
        )

    def bytes(self) -> bytes:
        return self.x.tobytes() + self.distance.tobytes()


@both
@pytest.mark.parametrize("n_members", SIZES)
def test_kernel_steps_as_numpy_does(kind, n_members, monkeypatch):
    """Same operations in the same order: the same bytes."""
    walkers = Walkers(build(kind, walk(), monkeypatch), np.arange(n_members))
    stream = NormalStream.from_key(KEY, walkers.members)
    x, gain = walkers.x.copy(), walkers.gain[:, None] * np.sqrt(DT)
    for step in (0, 1, 2, 820, 1640, 2460, 2**32 + 5, -3):
        assert walkers.call(step) == 0
        x = x + gain * stream.draw(step, 3)
        squares = x * x
        distance = np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2])
        assert walkers.x.tobytes() == x.tobytes()
        assert walkers.distance.tobytes() == distance.tobytes()


@both
def test_a_member_is_the_same_in_every_ensemble(kind, monkeypatch):
    kernel = build(kind, walk(), monkeypatch)
    alone = Walkers(kernel, [5])
    ensembles = [Walkers(kernel, members) for members in (range(7), range(100), [9, 5, 2])]
    for step in range(20):
        for walkers in (alone, *ensembles):
            walkers.call(step)
    for walkers, row in zip(ensembles, (5, 5, 1), strict=True):
        assert walkers.x[row].tobytes() == alone.x[0].tobytes()
        assert walkers.distance[row].tobytes() == alone.distance[0].tobytes()


@needs_compiler
@pytest.mark.parametrize("n_members", SIZES)
def test_compiled_and_virtual_agree_to_the_last_bit(n_members, monkeypatch):
    """Arithmetic and square roots, with much to contract or reassociate, over 50 steps."""
    n = 6
    x, p = ca.SX.sym("x", n), ca.SX.sym("p", n * n)
    P = ca.reshape(p, n, n)
    F = ca.SX.eye(n) + 0.01 * (ca.SX.ones(n, n) - x @ x.T / (1 + ca.sumsqr(x)))
    norm = ca.sqrt(1 + ca.sumsqr(F @ x))
    following = [F @ x / norm + 0.1, ca.vec(F @ P @ F.T / ca.sqrt(1 + ca.sumsqr(P)))]
    function = ca.Function("filter_step", [x, p], following, {"cse": True})
    specification = Specification(
        function,
        [Argument("x", n, "array"), Argument("p", n * n, "array")],
        [Result("x", n), Result("p", n * n)],
    )
    ends = []
    for kind in ("vector", "c", "vm"):
        rng = np.random.default_rng(3)
        arrays = {"x": rng.normal(size=(n_members, n)), "p": rng.normal(size=(n_members, n, n))}
        call = build(kind, specification, monkeypatch).bind(
            n_members,
            arrays,
            arrays,
            members=np.arange(n_members),
            noise_keys={},
            active=np.ones(n_members, dtype=bool),
            failed=np.zeros(n_members, dtype=np.uint8),
        )
        assert sum(call(step) for step in range(50)) == 0
        ends.append(arrays["x"].tobytes() + arrays["p"].tobytes())
    assert ends[0] == ends[1] == ends[2]


def pointwise(name: str, n: int, expression) -> Specification:
    """A function of standard normals alone: y = expression(w)."""
    w = ca.SX.sym("w", n)
    function = ca.Function(name, [w], [expression(w)])
    results = [Result("y", function.numel_out(0))]
    return Specification(function, [Argument("w", n, "noise")], results)


def evaluate(kernel, members, step: int) -> np.ndarray:
    members = np.asarray(members)
    y = np.zeros((len(members), kernel.results[0].size))
    kernel.bind(
        len(members),
        {},
        {"y": y},
        members=members,
        noise_keys={"w": KEY},
        active=np.ones(len(members), dtype=bool),
        failed=np.zeros(len(members), dtype=np.uint8),
    )(step)
    return y


@needs_compiler
def test_transcendental_functions_agree_to_rounding(monkeypatch):
    """Mathematical libraries may differ, by a unit in the last place each of three functions."""
    specification = pointwise("wave", 5, lambda w: ca.sin(w) * ca.exp(-w) + ca.atan2(w, 2))
    y = [evaluate(build(k, specification, monkeypatch), range(7), 3) for k in ("vector", "c", "vm")]
    w = NormalStream.from_key(KEY, np.arange(7)).draw(3, 5)
    for computed in y:
        np.testing.assert_allclose(
            computed, np.sin(w) * np.exp(-w) + np.arctan2(w, 2), rtol=4e-15, atol=1e-15
        )


@both
@pytest.mark.parametrize("n", [1, 2, 3, 9, 5000])
def test_noise_of_kernels_is_that_of_streams(kind, n, monkeypatch):
    """Odd and even counts, more than are drawn at once, members far apart."""
    some = sorted({0, n // 2, n - 1})
    kernel = build(kind, pointwise("noise", n, lambda w: w[some]), monkeypatch)
    for members, step in itertools.product(([0], range(150), [2**32 - 1, 3]), (0, 2**32, -1)):
        expected = NormalStream.from_key(KEY, np.asarray(members)).draw(step, n)[:, some]
        assert evaluate(kernel, members, step).tobytes() == expected.tobytes()


def test_generated_code_is_free_of_null_checks():
    """They make compilers slow: 5 minutes instead of seconds at 5,000 results."""
    for specification in (walk(), pointwise("many", 50, lambda w: w)):
        generated = kernel_source(VirtualMachineKernel(specification)).split("TERRAFIX_FUNCTION")[0]
        body = generated[generated.index("static int casadi_f0") :]
        body = body[: body.index("CASADI_SYMBOL_EXPORT")]
        assert "res[0][0]=" in body
        assert "?" not in body
        assert "if (" not in body


@pytest.mark.parametrize("kind", [pytest.param("c", marks=needs_compiler), "vm"])
def test_functions_that_call_functions_are_kernels_too(kind, monkeypatch):
    """MX code passes null pointers within: its checks must stay."""
    a, b = ca.SX.sym("a", 2), ca.SX.sym("b", 2)
    inner = ca.Function("inner", [a, b], [a + 2 * b, a * b], {"never_inline": True})
    w = ca.MX.sym("w", 2)
    first, second = inner(w, ca.MX.zeros(2)), inner(ca.MX.zeros(2), w)
    function = ca.Function("outer", [w], [first[0] + second[0]])
    specification = Specification(function, [Argument("w", 2, "noise")], [Result("y", 2)])
    y = evaluate(build(kind, specification, monkeypatch), range(7), 1)
    assert kind == "vm" or build_kernel(*specification).kind == "c"  # of itself
    monkeypatch.setenv("TERRAFIX_KERNEL", "vector")
    if kind == "c":
        with pytest.raises(ConfigurationError, match="'outer' cannot be one: it is a MXFunction"):
            build_kernel(*specification)
    w = NormalStream.from_key(KEY, np.arange(7)).draw(1, 2)
    assert y.tobytes() == (w + 2 * w).tobytes()


@compiled
def test_a_million_draws_are_the_same_in_c_and_numpy(kind, monkeypatch):
    kernel = build(kind, pointwise("noise", 1000, lambda w: w), monkeypatch)
    for step in range(2):
        expected = NormalStream.from_key(KEY, np.arange(600)).draw(step, 1000)
        assert evaluate(kernel, range(600), step).tobytes() == expected.tobytes()


@compiled
def test_every_branch_of_the_quantile_is_the_same_in_c_and_numpy(kind, monkeypatch):
    """Far tails, which a million draws never reach, both signs, and the seams between."""
    kernel = build(kind, pointwise("noise", 1, lambda w: w), monkeypatch)
    rng = np.random.default_rng(8)
    tails = np.concatenate(
        [2.0**-53 * np.arange(1, 40_000, 2), 10 ** rng.uniform(-15.5, -1, 10**5)]
    )
    seams = [c + k * 2.0**-53 for c in (0.075, 0.925, 0.5, np.exp(-25)) for k in range(-50, 50)]
    u = np.concatenate([tails, 1 - tails, rng.uniform(size=10**5), seams])
    u = rng.permutation(u[: len(u) // 64 * 64])
    z = u.copy()
    if kind == "c":
        kernel._library["terrafix_quantile"](ctypes.c_void_p(z.ctypes.data), ctypes.c_int64(z.size))
    else:
        whole = np.empty(len(u) + 8)
        start = -whole.ctypes.data % 64 // 8
        z = whole[start : start + len(u)]
        z[:] = u
        n = ctypes.c_int64(z.size // kernel.lanes)
        kernel._library["terrafix_normals"](ctypes.c_void_p(z.ctypes.data), n)
    assert (normal_quantile(u) < -7).sum() > 1000  # the far tail is reached
    assert z.tobytes() == normal_quantile(u).tobytes()


@both
def test_two_streams_of_one_component_are_drawn_from_their_own_keys(kind, monkeypatch):
    a, b = ca.SX.sym("a", 3), ca.SX.sym("b", 2)
    function = ca.Function("two", [a, b], [a, b])
    arguments = [Argument("a", 3, "noise"), Argument("b", 2, "noise")]
    kernel = build(
        kind, Specification(function, arguments, [Result("a", 3), Result("b", 2)]), monkeypatch
    )
    members, drawn = np.arange(130), {"a": np.zeros((130, 3)), "b": np.zeros((130, 2))}
    keys = {"a": stream_key(-1, "x", "a"), "b": stream_key(-1, "x", "b")}
    active = np.arange(130) % 3 != 0
    failed = np.zeros(130, dtype=np.uint8)
    kernel.bind(130, {}, drawn, members=members, noise_keys=keys, active=active, failed=failed)(12)
    for name, n in (("a", 3), ("b", 2)):
        expected = NormalStream.from_key(keys[name], members).draw(12, n)
        assert drawn[name][active].tobytes() == expected[active].tobytes()
        assert (drawn[name][~active] == 0).all()


@both
def test_fields_of_records_are_bound_where_they_lie(kind, monkeypatch):
    kernel = build(kind, walk(), monkeypatch)
    record = np.zeros(7, dtype=[("t", "f8"), ("x", "f8", 3), ("flag", "i8")])
    plain, strided = Walkers(kernel, range(7)), Walkers(kernel, range(7), x=record["x"])
    for step in range(5):
        plain.call(step)
        strided.call(step)
    assert record["x"].tobytes() == plain.x.tobytes()
    assert not record["t"].any()
    assert not record["flag"].any()


@both
def test_shared_arguments_are_read_at_each_call(kind, monkeypatch):
    walkers = Walkers(build(kind, walk(), monkeypatch), range(7))
    start = walkers.x.copy()
    walkers.dt[0] = 0.0
    walkers.call(1)
    assert (walkers.x == start).all()
    walkers.dt[0] = DT
    walkers.call(1)
    assert (walkers.x != start).all()


@both
def test_a_failing_member_is_left_as_it_was_and_the_others_go_on(kind, monkeypatch):
    kernel = build(kind, walk(), monkeypatch)
    walkers, untroubled = Walkers(kernel, range(100)), Walkers(kernel, range(100))
    others = np.arange(100) % 50 != 7
    for step in range(10):
        untroubled.call(step)
        if step == 4:
            before = walkers.x.copy(), walkers.distance.copy()
            walkers.gain[[7, 57]] = np.nan, np.inf
        assert walkers.call(step) == (2 if step == 4 else 0)
    assert walkers.failed.nonzero()[0].tolist() == [7, 57]
    assert set(walkers.failed.tolist()) == {0, 1}
    assert walkers.x[~others].tobytes() == before[0][~others].tobytes()
    assert walkers.distance[~others].tobytes() == before[1][~others].tobytes()
    assert walkers.x[others].tobytes() == untroubled.x[others].tobytes()


@both
def test_a_failure_of_the_last_result_leaves_the_first_alone(kind, monkeypatch):
    x = ca.SX.sym("x")
    function = ca.Function("root", [x], [x + 1, ca.sqrt(x - 3)])
    specification = Specification(
        function, [Argument("x", 1, "array")], [Result("x", 1), Result("y", 1)]
    )
    arrays = {"x": np.array([2.0, 4.0]), "y": np.array([9.0, 9.0])}
    failed = np.zeros(2, dtype=np.uint8)
    call = build(kind, specification, monkeypatch).bind(
        2,
        arrays,
        arrays,
        members=np.arange(2),
        noise_keys={},
        active=np.ones(2, dtype=np.uint8),
        failed=failed,
    )
    assert call(0) == 1
    assert failed.tolist() == [1, 0]
    assert arrays["x"].tolist() == [2, 5]
    assert arrays["y"].tolist() == [9, 1]


@both
def test_inactive_members_rest_and_resume(kind, monkeypatch):
    kernel = build(kind, walk(), monkeypatch)
    walkers, always = Walkers(kernel, range(100)), Walkers(kernel, range(100))
    walkers.active[::3] = False
    start = walkers.bytes()
    walkers.call(0)
    always.call(0)
    assert walkers.x[1].tobytes() == always.x[1].tobytes()
    assert (walkers.x[::3] == np.arange(0, 100, 3)[:, None] / 8).all()
    walkers.active[:] = False
    rested = walkers.bytes()
    assert walkers.call(1) == 0
    assert walkers.bytes() == rested != start
    walkers.active[:] = True
    walkers.call(0)
    assert walkers.x[::3].tobytes() == always.x[::3].tobytes()


def test_what_does_not_fit_is_refused_when_bound(monkeypatch):
    kernel = build("vm", walk(), monkeypatch)
    good = {
        "arrays": {"x": np.zeros((4, 3)), "gain": np.ones(4), "dt": np.ones(1)},
        "results": {"x": np.zeros((4, 3)), "distance": np.zeros(4)},
        "members": np.arange(4),
        "noise_keys": {"w": 1},
        "active": np.ones(4, dtype=bool),
        "failed": np.zeros(4, dtype=np.uint8),
    }
    kernel.bind(4, **good)
    frozen = np.zeros((4, 3))
    frozen.flags.writeable = False
    unaligned = np.zeros(4 * 25, dtype=np.uint8)[1:].view(np.uint8)[:96].view("f8").reshape(4, 3)
    for what, part, message in (
        ("arrays", {"dt": None}, "no array for 'dt'"),
        ("arrays", {"x": np.zeros((4, 2))}, r"'x' has shape \(4, 2\)"),
        ("arrays", {"x": np.zeros((3, 4))}, "needed are 4 rows of 3"),
        ("arrays", {"x": np.zeros((4, 3), dtype="f4")}, "float32"),
        ("arrays", {"x": np.zeros((3, 4)).T}, "not contiguous"),
        ("arrays", {"x": np.zeros((4, 6))[:, ::2]}, "not contiguous"),
        ("arrays", {"x": unaligned}, "not contiguous and aligned"),
        ("results", {"x": frozen}, "'x' is read-only"),
        ("noise_keys", {"w": None}, r"no noise key for \['w'\]"),
        ("members", np.arange(3), "4 members"),
        ("members", np.arange(4) - 1, "got -1"),
        ("active", np.ones(4), "'active' has shape"),
        ("failed", np.ones(3, dtype=np.uint8), "'failed' has shape"),
    ):
        changed = part
        if isinstance(part, dict):
            changed = {k: v for k, v in (good[what] | part).items() if v is not None}
        with pytest.raises(ValueError, match=message):
            kernel.bind(4, **(good | {what: changed}))


def test_declarations_that_do_not_fit_the_function_are_refused():
    function, arguments, results = walk()
    with pytest.raises(ValueError, match="the function has"):
        build_kernel(function, arguments[:-1], results)
    with pytest.raises(ValueError, match="'dt' is of kind 'global'; the kinds are array"):
        build_kernel(function, [*arguments[:-1], Argument("dt", 1, "global")], results)
    x = ca.SX.sym("x")
    sparse = ca.Function("sparse", [x], [ca.SX(ca.Sparsity(2, 1))])
    with pytest.raises(ValueError, match="densify"):
        build_kernel(sparse, [Argument("x", 1, "array")], [Result("y", 2)])


# ------------------------------------------------------------------------------------- the cache


@pytest.fixture
def counted(tmp_path, monkeypatch):
    """A compiler that counts its compilations, an empty cache, and a way to step with both."""
    real = next(command for command in toolchain._commands() if toolchain._identify(command))
    log = tmp_path / "log"
    script = tmp_path / "counting-cc"
    script.write_text(
        f'#!/bin/sh\n[ "$1" = --version ] || echo compiled >> "{log}"\nexec {" ".join(real)} "$@"\n'
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("TERRAFIX_CC", str(script))
    monkeypatch.setenv("TERRAFIX_KERNEL", "c")
    monkeypatch.setenv("TERRAFIX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(toolchain, "_session_directory", lambda: tmp_path / "session")
    return lambda: len(log.read_text().splitlines()) if log.exists() else 0


def stepped() -> bytes:
    kernel = build_kernel(*walk())
    assert kernel.kind == "c"
    walkers = Walkers(kernel, range(7))
    walkers.call(0)
    return walkers.bytes()


def libraries() -> list[Path]:
    return sorted(toolchain.cache_directory().iterdir())


posix = pytest.mark.skipif(os.name != "posix", reason="needs a shell and its permissions")


@posix
@needs_compiler
def test_libraries_are_compiled_once(counted):
    first = stepped()
    assert counted() == 1
    assert stepped() == first
    assert counted() == 1
    assert len(libraries()) == 1


@posix
@needs_compiler
def test_a_library_is_made_anew_for_whatever_it_depends_on(counted, monkeypatch):
    """Source, options, compiler; the processor where it is for that alone, and only there."""
    source = '__attribute__((visibility("default"))) char terrafix_key[] = TERRAFIX_KEY;\n'
    compiler = toolchain.find_compiler()

    def compiled(text=source, *, native=False):
        toolchain.load(text, native=native)
        return counted()

    assert [compiled(), compiled(), compiled(source + "int more;\n")] == [1, 1, 2]
    assert [compiled(native=True), compiled(native=True)] == [3, 3]
    monkeypatch.setattr(toolchain, "cpu_features", lambda: "another processor")
    assert [compiled(), compiled(native=True)] == [3, 4]
    monkeypatch.setattr(toolchain, "FLAGS", (*toolchain.FLAGS, "-DMORE"))
    assert [compiled(), compiled(native=True)] == [5, 5]
    other = replace(compiler, version="another version")
    monkeypatch.setattr(toolchain, "_identify", lambda command: other)
    assert [compiled(), compiled(native=True)] == [6, 7]


@posix
@needs_compiler
def test_another_process_finds_the_library(counted):
    """So the generated source, which the name is made of, is the same in every process."""
    stepped()
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
    code += "import test_kernels; test_kernels.stepped()"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert counted() == 1


@posix
@needs_compiler
@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "another", "garbage"])
def test_a_damaged_library_is_rebuilt(counted, damage, tmp_path):
    """In processes of their own: one that has loaded a library keeps it."""
    first = stepped()
    (library,) = libraries()
    content = library.read_bytes()
    library.unlink()
    if damage == "another":  # intact in itself, but not what its name says: the key inside tells
        other = build_kernel(*pointwise("noise", 3, lambda w: w))
        assert other.kind == "c"
        (path,) = libraries()
        path.rename(
            path.with_name(library.stem.split("-")[0] + "-" + path.stem.split("-")[1] + path.suffix)
        )
    elif damage == "garbage":
        garbage = b"not a library" * 100
        digest = toolchain.sha256(garbage).hexdigest()[:16]
        library.with_name(f"{library.stem.split('-')[0]}-{digest}{library.suffix}").write_bytes(
            garbage
        )
    else:
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        library.write_bytes(
            {"truncated": content[:middle], "flipped": flipped, "empty": b""}[damage]
        )
    compiled = counted()
    assert stepped() == first
    assert counted() == compiled + 1
    assert len(libraries()) == 1


@posix
@needs_compiler
def test_a_cache_that_cannot_be_written_is_done_without(counted, tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("a file where the cache should be")
    monkeypatch.setenv("TERRAFIX_CACHE", str(blocked))
    first = stepped()
    assert stepped() == first
    assert counted() == 1
    assert blocked.read_text() == "a file where the cache should be"


@posix
@needs_compiler
def test_several_kernels_are_compiled_together_and_equal_ones_once(counted):
    specifications = [walk(), pointwise("noise", 3, lambda w: w), walk()]
    reports = []
    kernels = build_kernels(specifications, lambda done, total: reports.append((done, total)))
    assert [kernel.name for kernel in kernels] == ["walk_step", "noise", "walk_step"]
    assert reports == [(1, 2), (2, 2)]
    assert counted() == 2


@posix
@needs_compiler
def test_processes_that_build_at_the_same_time_do_not_disturb_one_another(counted):
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
    code += "import test_kernels; sys.stdout.write(test_kernels.stepped().hex())"
    command = [sys.executable, "-c", code]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    expected = stepped().hex()
    assert {process.communicate()[0] for process in running} == {expected}


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"TERRAFIX_CACHE": "/a"}, "/a/kernels"),
        ({"XDG_CACHE_HOME": "/b"}, "/b/terrafix/kernels"),
        ({"HOME": "/c"}, "/c/.cache/terrafix/kernels"),
    ],
)
@pytest.mark.skipif(sys.platform != "linux", reason="the rules of Linux")
def test_the_cache_lies_where_the_user_says(variables, expected, monkeypatch):
    for name in ("TERRAFIX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert toolchain.cache_directory() == Path(expected)


@needs_compiler
def test_a_user_without_a_home_gets_libraries_too(monkeypatch):
    def homeless(*_, **__):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.delenv("TERRAFIX_CACHE", raising=False)
    monkeypatch.setattr("platformdirs.user_cache_path", homeless)
    source = '__attribute__((visibility("default"))) double seven(void) { return 7.0; }\n'
    assert toolchain.load(source)["seven"]


# ------------------------------------------------------------------------------------- compilers


@needs_compiler
def test_the_compiler_is_named(monkeypatch):
    kernel = build_kernel(*walk())
    assert kernel.note == ""
    compiler = toolchain.find_compiler()
    assert toolchain.describe([kernel]) == f"kernels: {compiler.name}, vectors of members"
    monkeypatch.setenv("TERRAFIX_KERNEL", "c")
    assert toolchain.describe([build_kernel(*walk())]) == f"kernels: {compiler.name}, plain C"
    assert any(character.isdigit() for character in compiler.name)


@posix
def test_a_broken_compiler_falls_back_and_says_so(monkeypatch):
    monkeypatch.setenv("TERRAFIX_CC", "/bin/false")
    kernels = build_kernels([walk(), pointwise("noise", 3, lambda w: w)])
    assert [kernel.kind for kernel in kernels] == ["vm", "vm"]
    line = toolchain.describe(kernels)
    assert line.startswith(
        "kernels: CasADi virtual machine ('/bin/false' failed with exit status 1"
    )
    assert "\n" not in line
    Walkers(kernels[0], range(3)).call(0)


@posix
def test_a_broken_compiler_is_an_error_where_c_is_demanded(monkeypatch):
    monkeypatch.setenv("TERRAFIX_CC", "/bin/false")
    monkeypatch.setenv("TERRAFIX_KERNEL", "c")
    with pytest.raises(ConfigurationError, match=r"TERRAFIX_KERNEL=c .*'/bin/false' failed"):
        build_kernel(*walk())


def test_a_compiler_that_does_not_exist_is_named(monkeypatch):
    monkeypatch.setenv("TERRAFIX_CC", "no-such-cc")
    assert build_kernel(*walk()).kind == "vm"
    assert toolchain.describe() == (
        "kernels: CasADi virtual machine (TERRAFIX_CC names 'no-such-cc', which cannot be run)"
    )


def test_without_a_compiler_the_virtual_machine_serves(monkeypatch):
    monkeypatch.setattr(toolchain, "_commands", lambda: iter(()))
    monkeypatch.delenv("TERRAFIX_CC", raising=False)
    assert build_kernel(*walk()).kind == "vm"
    assert toolchain.describe() == (
        "kernels: CasADi virtual machine "
        "(no C compiler found; install one or `pip install terrafix[ziglang]`)"
    )
    monkeypatch.setenv("TERRAFIX_KERNEL", "c")
    with pytest.raises(ConfigurationError, match="no C compiler found; install one"):
        build_kernel(*walk())


@posix
@needs_compiler
def test_a_compiler_that_does_not_work_is_passed_over_for_the_next(monkeypatch):
    real = next(toolchain._commands())
    monkeypatch.setattr(toolchain, "_commands", lambda: iter([("/bin/false",), real]))
    kernel = build_kernel(*walk())
    assert kernel.kind == "vector"
    assert "false" not in toolchain.describe([kernel])


@needs_compiler
def test_one_refused_kernel_leaves_the_others_compiled(monkeypatch):
    """A function that has the name of a C function cannot be compiled, but interpreted."""
    monkeypatch.setattr(toolchain, "VECTOR_FLAGS", ("-no-such-flag",))
    kernels = build_kernels([walk(), pointwise("sqrt", 3, lambda w: w)])
    assert [kernel.kind for kernel in kernels] == ["c", "vm"]
    line = toolchain.describe(kernels)
    assert ", plain C; CasADi virtual machine for 'sqrt' (" in line
    assert "\n" not in line


def test_the_virtual_machine_can_be_chosen(monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", "vm")
    assert build_kernel(*walk()).kind == "vm"
    assert toolchain.describe() == "kernels: CasADi virtual machine (TERRAFIX_KERNEL=vm)"


def test_an_unknown_choice_is_refused(monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", "fast")
    with pytest.raises(ConfigurationError, match="TERRAFIX_KERNEL is 'fast'; write 'vector' for"):
        build_kernel(*walk())


def test_importing_kernels_does_not_import_casadi():
    code = "import sys, terrafix.cosim.kernels.build; sys.exit('casadi' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@needs_compiler
def test_every_operation_of_vectors_is_that_of_the_virtual_machine(monkeypatch):
    """Comparisons, choices, signs, minima, NaN on the way, and the library where lanes differ."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    results = [
        ca.if_else(x < y, x - y, ca.atan2(x, y)),
        ca.if_else(ca.logic_and(x <= 0.5, ca.logic_not(y == 0)), ca.sin(x), ca.fabs(y)),
        ca.if_else(ca.logic_or(x != 1.0, y > 2), ca.sign(x), 7.0),
        ca.fmin(x, y) + ca.fmax(x, 2.0) * ca.copysign(x, y),
        ca.floor(x) + ca.ceil(y) - ca.fmod(x, 0.75),
        ca.if_else(y > 0, ca.log(y), 0.0),
        -(x**2) + 2 * y + 1 / (1 + x * x) + ca.sqrt(1 + y * y) + x**3,
        ca.exp(-ca.fabs(x)) + ca.tanh(y) + ca.hypot(x, y) + ca.erf(x),
    ]
    function = ca.Function("everything", [x, y], [ca.vertcat(*results)])
    specification = Specification(
        function, [Argument("x", 1, "array"), Argument("y", 1, "array")], [Result("z", 8)]
    )
    values = np.array([-2.5, -1.0, -0.0, 0.0, 0.5, 1.0, 1.75, 3.0])
    grid = np.stack(np.meshgrid(values, values), axis=-1).reshape(-1, 2)
    alike = np.full((16, 2), 0.375)
    for cases in (grid, alike):
        found = []
        for kind in ("vector", "vm"):
            z = np.zeros((len(cases), 8))
            build(kind, specification, monkeypatch).bind(
                len(cases),
                {"x": cases[:, 0].copy(), "y": cases[:, 1].copy()},
                {"z": z},
                members=np.arange(len(cases)),
                noise_keys={},
                active=np.ones(len(cases), dtype=bool),
                failed=np.zeros(len(cases), dtype=np.uint8),
            )(0)
            found.append(z)
        np.testing.assert_allclose(*found, rtol=1e-15, atol=0)
        assert np.isfinite(found[0]).all()


def test_a_kept_kernel_is_that_of_its_model():
    """Changing a choice back and forth: a cache by address flew another choice's kernel."""

    class Sign(tf.SymbolicComponent):
        default_rate = tf.Rate("1")
        way = tf.Choice(("plus", "minus", "twice"), "plus")
        y = tf.Output()

        def build_model(self):
            factor = {"plus": 1.0, "minus": -1.0, "twice": 2.0}[self.way]
            x = ca.SX.sym("x")
            return tf.Model("sign", states={"x": x}, next={"x": x + factor}, outputs={"y": x})

    system = tf.System("signs", duration="1")
    part = system.add(Sign(), "part")
    system.record("y", [part["y"]])
    for k in range(40):
        part.way, expected = [("plus", 1.0), ("minus", -1.0), ("twice", 2.0)][k % 3]
        assert tf.simulate(system).dataset["part.y"][-1].item() == expected
