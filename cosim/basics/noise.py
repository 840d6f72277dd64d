r"""Counter-based standard normals: a pure function of names and numbers, without hidden state.

A draw is a function of (root seed, component path, stream name, member, step, index) and of
nothing else: not of the other components, of how an ensemble is split, or of the order of
calls. The first three are hashed to a 64-bit key :math:`\kappa`; the rest is the counter of the
block cipher Philox4x32-10 [1]_,

.. math::
    (w_0, w_1, w_2, w_3) = \mathrm{Philox}_\kappa(\lfloor i/2 \rfloor,\; m,\;
        s \bmod 2^{32},\; \lfloor s/2^{32} \rfloor),

with index :math:`i`, member :math:`m` and step :math:`s`. Even indices take
:math:`x = w_0 + 2^{32} w_1`, odd ones :math:`x = w_2 + 2^{32} w_3`, and

.. math::
    u = \bigl(2 \lfloor x / 2^{12} \rfloor + 1\bigr)\, 2^{-53}, \qquad z = \Phi^{-1}(u),

so that :math:`u` is exact, symmetric about 1/2 and never 0 or 1 (:math:`|z| < 8.3`), and
:math:`\Phi^{-1}` is Wichura's algorithm AS 241, PPND16 [2]_.

The same numbers are drawn by compiled kernels (``kernel.c``), to the last bit. Hence everything
here is built from additions, multiplications, divisions and square roots in a fixed order,
which IEEE 754 rounds alike everywhere; the logarithm of the tails is our own [3]_.

References
----------
.. [1] J. Salmon, M. Moraes, R. Dror, D. Shaw, "Parallel random numbers: as easy as 1, 2, 3",
   Proc. SC11, 2011; constants and known answers from the Random123 library, version 1.14.
.. [2] M. Wichura, "Algorithm AS 241: the percentage points of the normal distribution",
   Applied Statistics 37(3), 1988, 477-484.
.. [3] FreeBSD ``msun``, ``e_log.c`` (Sun Microsystems, 1993): reduction to
   :math:`[\sqrt{1/2}, \sqrt 2)` and a polynomial in :math:`s^2`, :math:`s = f/(2+f)`.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from hashlib import blake2b

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.cosim.basics.arrays import FloatArray

IntArray = NDArray[np.int64]
_Words = NDArray[np.uint64]

_MULTIPLIERS = np.array([[0xD2511F53], [0xCD9E8D57]], dtype=np.uint64)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10
_WORD = 0xFFFFFFFF
_LOW_WORD = np.uint64(_WORD)
_HALF = np.uint64(32)
_CHUNK = 4096  # ciphers at a time: the working set stays in the cache

# AS 241, highest power first: numerator and denominator of the center, the near and the far tail
_CENTER = (
    (2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4,
     4.5921953931549871457e4, 1.3731693765509461125e4, 1.9715909503065514427e3,
     1.3314166789178437745e2, 3.3871328727963666080e0),
    (5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4,
     2.1213794301586595867e4, 5.3941960214247511077e3, 6.8718700749205790830e2,
     4.2313330701600911252e1, 1.0),
)  # fmt: skip
_NEAR = (
    (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1,
     1.27045825245236838258e0, 3.64784832476320460504e0, 5.76949722146069140550e0,
     4.63033784615654529590e0, 1.42343711074968357734e0),
    (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2,
     1.48103976427480074590e-1, 6.89767334985100004550e-1, 1.67638483018380384940e0,
     2.05319162663775882187e0, 1.0),
)  # fmt: skip
_FAR = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3,
     2.65321895265761230930e-2, 2.96560571828504891230e-1, 1.78482653991729133580e0,
     5.46378491116411436990e0, 6.65790464350110377720e0),
    (2.04426310338993978564e-15, 1.42151175831644588870e-7, 1.84631831751005468180e-5,
     7.86869131145613259100e-4, 1.48753612908506148525e-2, 1.36929880922735805310e-1,
     5.99832206555887937690e-1, 1.0),
)  # fmt: skip


def stream_key(seed: int, path: str, stream: str) -> int:
    """Hash (root seed, component path, stream name) to the 64-bit key of a stream.

    Any integer is a seed, negative and huge ones included. The parts are hashed with their
    lengths, so that no two triples read alike.
    """
    digest = blake2b(digest_size=8, person=b"terrafix noise")
    for part in (str(operator.index(seed)), path, stream):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    return int.from_bytes(digest.digest(), "little")


def _cipher(even: _Words, odd: _Words, key: int) -> tuple[_Words, _Words]:
    """Encrypt counters (c0, c2) and (c1, c3), shape (2, n), words in the low halves.

    Both arrays are overwritten.
    """
    k0, k1 = key & _WORD, key >> 32
    product = np.empty_like(even)
    for _ in range(_ROUNDS):
        np.multiply(even, _MULTIPLIERS, out=product)
        np.right_shift(product, _HALF, out=even)
        odd ^= even[::-1]
        odd ^= np.array([[k0], [k1]], dtype=np.uint64)
        np.bitwise_and(product[::-1], _LOW_WORD, out=even)
        even, odd = odd, even
        k0, k1 = (k0 + _WEYL[0]) & _WORD, (k1 + _WEYL[1]) & _WORD
    return even, odd


def philox4x32(counter: ArrayLike, key: ArrayLike) -> NDArray[np.uint32]:
    """Encrypt counters of four 32-bit words under a key of two, in ten rounds.

    Parameters
    ----------
    counter : array_like, shape (..., 4)
        Words of 32 bits, as integers.
    key : array_like, shape (2,)
        As above.

    Returns
    -------
    ndarray of uint32, shape (..., 4)
    """
    words = np.array(counter, dtype=np.uint64)
    low, high = (int(word) for word in np.asarray(key, dtype=np.uint64))
    flat = words.reshape(-1, 4).T
    even, odd = _cipher(flat[0::2], flat[1::2], low | high << 32)
    mixed = np.stack([even[0], odd[0], even[1], odd[1]], axis=-1)
    return mixed.astype(np.uint32).reshape(words.shape)


def _horner(coefficients: Sequence[float], x: FloatArray) -> FloatArray:
    value = coefficients[0] * x + coefficients[1]
    for coefficient in coefficients[2:]:
        value *= x
        value += coefficient
    return value


def _ratio(polynomials: tuple[Sequence[float], Sequence[float]], x: FloatArray) -> FloatArray:
    return _horner(polynomials[0], x) / _horner(polynomials[1], x)


def _log(x: FloatArray) -> FloatArray:
    """Natural logarithm of positive normal numbers, to one unit in the last place [3]_."""
    bits = x.view(np.uint64) + np.uint64(0x3FF0000000000000 - 0x3FE6A09E00000000)
    exponent = (bits >> np.uint64(52) | np.uint64(0x4330000000000000)).view(np.float64)
    k = exponent - (2.0**52 + 1023)
    mantissa = (bits & np.uint64(0xFFFFFFFFFFFFF)) + np.uint64(0x3FE6A09E00000000)
    f = mantissa.view(np.float64) - 1
    s = f / (2 + f)
    z = s * s
    w = z * z
    odd = w * (
        3.999999999940941908e-1 + w * (2.222219843214978396e-1 + w * 1.531383769920937332e-1)
    )
    even = z * (
        6.666666666666735130e-1
        + w
        * (2.857142874366239149e-1 + w * (1.818357216161805012e-1 + w * 1.479819860511658591e-1))
    )
    half = 0.5 * f * f
    low = s * (half + (even + odd)) + k * 1.90821492927058770002e-10
    return low - half + f + k * 6.93147180369123816490e-1


def normal_quantile(u: ArrayLike) -> FloatArray:
    r"""Inverse :math:`\Phi^{-1}(u)` of the standard normal distribution function, 0 < u < 1.

    AS 241 (PPND16): about one part in 10\ :sup:`16`, and the same bits as ``kernel.c``.
    """
    u = np.asarray(u, dtype=np.float64)
    shape, u = u.shape, u.ravel()
    q = u - 0.5
    z = q * _ratio(_CENTER, 0.180625 - q * q)
    tail = np.flatnonzero(np.abs(q) > 0.425)
    if tail.size:
        q, u = q[tail], u[tail]
        r = np.sqrt(-_log(np.where(q < 0, u, 1 - u)))
        beyond = _ratio(_NEAR, r - 1.6)
        far = np.flatnonzero(r > 5)
        if far.size:
            beyond[far] = _ratio(_FAR, r[far] - 5)
        z[tail] = np.copysign(beyond, q)
    return z.reshape(shape)


def check_members(members: ArrayLike) -> IntArray:
    """Copy identities of members, shape (n_members,), or raise ValueError if out of range."""
    checked = np.array(members, dtype=np.int64).reshape(-1)
    outside = (checked < 0) | (checked > _WORD)
    if outside.any():
        raise ValueError(f"members are numbered from 0 to {_WORD}, got {checked[outside][0]}")
    return checked


class NormalStream:
    """Standard normals of one stream of one component, for some members of an ensemble.

    Parameters
    ----------
    seed : int
        Root seed of the run or campaign.
    path : str
        Path of the component in its system.
    stream : str
        Name of the stream within the component.
    members : ndarray of int64, shape (n_members,)
        Identities of the members, 0 to 2**32 - 1, in any order.

    Raises
    ------
    ValueError
        If a member is out of range.
    """

    def __init__(self, seed: int, path: str, stream: str, members: ArrayLike) -> None:
        self._set(stream_key(seed, path, stream), members)

    @classmethod
    def from_key(cls, key: int, members: ArrayLike) -> NormalStream:
        """Make the stream whose `stream_key` is `key`."""
        stream = cls.__new__(cls)
        stream._set(key, members)
        return stream

    def _set(self, key: int, members: ArrayLike) -> None:
        self.key = key
        self.members = check_members(members)

    def uniform(self, step: int, n: int) -> FloatArray:
        """Uniform numbers in (0, 1) of one step, shape (n_members, n)."""
        numbers: FloatArray = self.uniform_at([step], n)[0]
        return numbers

    def draw(self, step: int, n: int) -> FloatArray:
        """Standard normals of one step, shape (n_members, n)."""
        numbers: FloatArray = self.draw_at([step], n)[0]
        return numbers

    def block(self, first_step: int, n_steps: int, n: int) -> FloatArray:
        """Standard normals of consecutive steps, shape (n_steps, n_members, n)."""
        return self.draw_at(range(first_step, first_step + n_steps), n)

    def draw_at(self, steps: Sequence[int], n: int) -> FloatArray:
        """Standard normals of any steps, shape (len(steps), n_members, n)."""
        return self._numbers(steps, n, normal=True)

    def uniform_at(self, steps: Sequence[int], n: int) -> FloatArray:
        """Uniform numbers in (0, 1) of any steps, shape (len(steps), n_members, n)."""
        return self._numbers(steps, n, normal=False)

    def _numbers(self, steps: Sequence[int], n: int, *, normal: bool) -> FloatArray:
        """Steps are 64-bit integers, of either sign."""
        n_pairs = (n + 1) // 2
        shape = (len(steps), len(self.members), n_pairs)
        step = np.array(steps, dtype=np.int64).view(np.uint64)[:, None, None]
        counter = [
            np.broadcast_to(word, shape).reshape(-1)
            for word in (
                np.arange(n_pairs, dtype=np.uint64),
                self.members.astype(np.uint64)[:, None],
                step & _LOW_WORD,
                step >> _HALF,
            )
        ]
        numbers = np.empty((*shape, 2))
        flat = numbers.reshape(-1, 2)
        for start in range(0, len(flat), _CHUNK):
            c0, c1, c2, c3 = (word[start : start + _CHUNK] for word in counter)
            even, odd = _cipher(np.stack([c0, c2]), np.stack([c1, c3]), self.key)
            # 52 random bits as the mantissa of a number in [1, 2): an exact conversion
            bits = (odd << np.uint64(20)) | (even >> np.uint64(12)) | np.uint64(0x3FF0000000000000)
            uniform = (bits.view(np.float64) - 1) + 2.0**-53
            flat[start : start + _CHUNK] = (normal_quantile(uniform) if normal else uniform).T
        return numbers.reshape(shape[0], shape[1], 2 * n_pairs)[:, :, :n]


class NormalBlocks:
    """A stream read step by step, drawn many steps at a time where the steps are regular.

    NumPy needs some 0.2 ms for a call however little it draws. The numbers are those of
    `NormalStream.draw`; only the time they take differs.

    Parameters
    ----------
    stream : NormalStream
        The stream.
    n : int
        Numbers per member and step.
    """

    _AHEAD = 8192  # numbers drawn at once

    def __init__(self, stream: NormalStream, n: int) -> None:
        self._stream = stream
        self._n = n
        self._steps = max(1, self._AHEAD // max(1, n * len(stream.members)))
        self._rows: dict[int, FloatArray] = {}
        self._last: int | None = None
        self._stride: int | None = None

    def draw(self, step: int) -> FloatArray:
        """Standard normals of one step, shape (n_members, n); to be read, not written."""
        row = self._rows.get(step)
        if row is None:
            stride = None if self._last is None else step - self._last
            n_steps = self._steps if stride and stride == self._stride else 1
            steps = range(step, step + n_steps * (stride or 1), stride or 1)
            self._rows = dict(zip(steps, self._stream.draw_at(steps, self._n), strict=True))
            self._stride = stride
            row = self._rows[step]
        self._last = step
        return row
