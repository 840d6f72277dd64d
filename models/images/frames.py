r"""Frames of a scene: what a camera that stares gives.

A scene is an image of the ground on a grid of meters north and east. A pixel at :math:`p`, north
and east of a frame's middle, shows the ground at :math:`V^{-1}(p - t)` from the target, with
:math:`V` the pixels of a meter and t the target's place in the frame. What blurs all frames alike,
point spread and motion, blurs the scene once.

Images have rows downward, which is south, and columns to the east.

References
----------
.. [1] "Satellite-Based Fusion of Image/Inertial Sensors for Precise Geolocation", AFIT thesis,
       eq. (2.70) and sections 3.4 to 3.6.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray, Single

_NORTH_EAST = np.array([[0.0, -1.0], [1.0, 0.0]])
"""From (column, row) of an image to north and east."""
_TAPS = 4
"""Pixels to either side that tell one between them."""
_SMOOTH = 1e-6
"""Length of a motion that blurs nothing [px]."""
_CLOUD = 250.0
"""Code of a cloud."""


def textured_scene(
    size: int, seed: int, *, middle: float = 128.0, contrast: float = 40.0
) -> Single:
    """A scene whose amplitudes fall with frequency, as those of nature do: (size, size) codes.

    Parameters
    ----------
    size : int
        Rows and columns.
    seed : int
    middle, contrast : float
        Mean and standard deviation.
    """
    rng = np.random.default_rng(seed)
    f = np.fft.fftfreq(size)
    frequency = np.hypot(f[:, None], np.fft.rfftfreq(size))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / frequency
    field = np.fft.irfft2(spectrum, (size, size))
    return np.asarray(middle + contrast * field / field.std(), np.float32)


def blurred(scene: Single, sigma: float, motion: tuple[float, float] = (0.0, 0.0)) -> Single:
    """A scene behind a point spread of a standard deviation, moved while it was exposed [px of it].

    Parameters
    ----------
    scene : ndarray of float32, shape (rows, columns)
    sigma : float
        Of the Gaussian point spread.
    motion : (float, float)
        How far it moves, along rows and along columns: a mean over that line.
    """
    result = scene
    if sigma > 0:
        spread = cv2.GaussianBlur(result, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
        result = np.asarray(spread, np.float32)
    length = float(np.hypot(*motion))
    if length > _SMOOTH:
        half = int(np.ceil(length / 2)) + 1
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        for s in np.linspace(-0.5, 0.5, 32 * half):
            row, column = half + s * motion[0], half + s * motion[1]
            i, j = int(row), int(column)
            u, w = row - i, column - j
            kernel[i : i + 2, j : j + 2] += np.outer((1 - u, u), (1 - w, w)).astype(np.float32)
        moved = cv2.filter2D(result, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
        result = np.asarray(moved, np.float32)
    return result


def frame_to_scene(
    target: ArrayLike, view: ArrayLike, place: ArrayLike, grid: ArrayLike, size: int
) -> FloatArray:
    """Affine transforms from (column, row) of frames to (column, row) of a scene, (n, 2, 3).

    Parameters
    ----------
    target : array_like, shape (n, 2)
        Where the target lies in each frame, north and east of its middle [px].
    view : array_like, shape (n, 2, 2)
        Pixels by meters north and east [px/m].
    place : array_like, shape (2,)
        Column and row of the target in the scene.
    grid : array_like, shape (2, 2)
        Columns and rows of the scene by meters north and east [px/m].
    size : int
        Rows and columns of the frame.
    """
    t, V = np.asarray(target, np.float64), np.asarray(view, np.float64)
    inverse = np.linalg.inv(V)
    # (column, row) -> (north, east) in the frame -> meters -> (column, row) of the scene
    out = np.asarray(grid, np.float64)
    A = out @ inverse @ _NORTH_EAST
    middle = (size - 1) / 2
    shift = np.asarray(place) - A.sum(axis=2) * middle - (out @ inverse @ t[..., None])[..., 0]
    return np.concatenate([A, shift[..., None]], axis=2)


def inside(transform: FloatArray, size: int, shape: tuple[int, int]) -> np.ndarray:
    """Whether frames lie wholly on a scene of a shape, with a pixel to interpolate from: (n,)."""
    corners = np.array([[0, 0, 1], [size - 1, 0, 1], [0, size - 1, 1], [size - 1, size - 1, 1]])
    at = np.einsum("nij,kj->nki", transform, corners.astype(np.float64))
    last = np.array([shape[1], shape[0]]) - 3
    return np.asarray(((at >= 2) & (at <= last)).all(axis=(1, 2)))


def sampled(scene: Single, transform: FloatArray, size: int) -> Single:
    """A frame (size, size) of a scene, by a transform of `frame_to_scene`; cubic between pixels."""
    return np.asarray(
        cv2.warpAffine(
            scene,
            transform,
            (size, size),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT,
        )
    )


def turned_back(frame: Single, from_first: FloatArray) -> Single:
    """A frame as the first one would show it, about its middle.

    Parameters
    ----------
    frame : ndarray of float32, shape (n, n)
    from_first : ndarray, shape (2, 2)
        Pixels north and east in the frame by those in the first one.
    """
    middle, size = (frame.shape[0] - 1) / 2, frame.shape[0]
    grid = _NORTH_EAST.T @ from_first
    back = frame_to_scene(np.zeros((1, 2)), np.eye(2)[None], (middle, middle), grid, size)
    return np.asarray(
        cv2.warpAffine(
            frame,
            back[0],
            frame.shape,
            flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT,
        )
    )


def shifted(image: Single, row: float, column: float) -> Single:
    """An image moved by parts of a pixel, down and to the right.

    By a sinc in a window of four pixels to either side: what cubic polynomials take off the finest
    detail makes a match off by 0.02 px.
    """
    k = np.arange(1 - _TAPS, 1 + _TAPS)
    kernels = []
    for by in (row, column):
        whole = int(np.floor(-by))
        x = k - (-by - whole)
        taps = np.sinc(x) * np.sinc(x / _TAPS)
        kernel = np.zeros(2 * (_TAPS + abs(whole)) + 1, np.float32)
        kernel[k + whole + _TAPS + abs(whole)] = taps / taps.sum()
        kernels.append(kernel)
    moved = cv2.sepFilter2D(image, -1, kernels[1], kernels[0], borderType=cv2.BORDER_REFLECT)
    return np.asarray(moved, np.float32)


def hidden_square(frame: Single, side: int, rng: np.random.Generator) -> None:
    """Hide a part of a frame behind a bright square of a side [px] somewhere in it, in place."""
    row, column = (int(rng.integers(0, n - side + 1)) for n in frame.shape)
    frame[row : row + side, column : column + side] = _CLOUD


def coded(frame: Single, noise: float, bits: int, rng: np.random.Generator) -> Single:
    """A frame with noise [codes], as whole codes from 0 to 2^bits - 1; bits 0: as it is."""
    if noise > 0:
        grain = rng.standard_normal(frame.shape, dtype=np.float32)
        grain *= np.float32(noise)
        frame = frame + grain
    if bits:
        frame = np.rint(frame)
        np.maximum(frame, 0.0, out=frame)
        np.minimum(frame, 2**bits - 1, out=frame)
    return np.asarray(frame, np.float32)
