"""A camera that looks down, and the outlines of lakes that it sees."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.components.fields import (
    CENTERS,
    CONTOUR,
    CORNERS,
    FRAME,
    LOOK,
    MOST_VERTICES,
    OWNER,
    RADII,
    STARTS,
    XYZ,
)
from terrafix.components.sensors.optics import Optics, say_islands_left_out
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Count, Parameter
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput, Output, SharedInput
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import geodetic
from terrafix.models.images.polygons import split_rings
from terrafix.models.images.rendering import (
    Appearance,
    cloud_opacity,
    render_polygon,
    render_scene,
)
from terrafix.models.maps.outlines import rings_of
from terrafix.models.sensors.camera import (
    Seen,
    ground_in_view,
    in_view,
    lens_grows,
    nearest_to_axis,
)

_log = logging.getLogger(__name__)

CLIPPING = ("frame", "none")
"""What becomes of an outline that is not wholly in the frame."""


class LakeCamera(Optics):
    """Outlines of lakes in the frame of a camera.

    It looks down, the velocity upward in the frame, or as the body is turned that carries it, but
    for its mounting and for a misalignment that every member draws once. Each frame shows one
    lake, the nearest to its center of those that are wholly in it, or in it at all. A run in which
    it never had one says by how much.
    """

    default_rate = Rate("1/30")

    size = Parameter([320.0, 256.0], shape=(2,), unit="px", positive=True, doc="of the frame")
    vertex_sigma = Parameter(0.25, unit="px", minimum=0.0, doc="noise of every vertex")
    attitude_sigma = Parameter(
        0.0, unit="rad", minimum=0.0, doc="of the misalignment about each axis, drawn once"
    )
    catalog_sigma = Parameter(
        0.0, unit="m", minimum=0.0, doc="of the true vertices about the catalog's, drawn once"
    )
    clipping = Choice(
        CLIPPING,
        "frame",
        doc="frame: an outline that is not wholly in it is told as such; none: a frame without end",
    )

    r_i = Input((3,), unit="m", frame="i", doc="true position")
    v_i = Input((3,), unit="m/s", frame="i", doc="true velocity")
    vertices = SharedInput(**CORNERS, doc="of the rings of all lakes")
    starts = SharedInput(**STARTS, doc="of rings in the vertices")
    center = SharedInput(**CENTERS, doc="of each lake")
    radius = SharedInput(**RADII, doc="around each center")
    owner = SharedInput(
        **OWNER, optional=True, doc="lake of each ring; where islands are to be seen"
    )

    contour = MessageOutput(**CONTOUR, doc="vertices of the lake's outline in the frame")
    look = MessageOutput(fields=LOOK, doc="which lake it is, and how well it is seen")
    attitude = Output((3,), unit="rad", frame="c", labels=XYZ, doc="misalignment of the camera")

    def _initialize_impl(self) -> None:
        n = self.n_members
        self.check_pointing()
        for lens, focal, size in zip(self.lens, self.focal, self.size, strict=True):
            reach = float(np.linalg.norm(size) / focal)
            if not lens_grows(lens, reach):
                raise ConfigurationError(
                    f"'{self.name}.lens' folds the scene back into the frame within "
                    f"{np.degrees(np.arctan(reach)):.1f} deg of the axis: its radial part does not "
                    "grow there\n  calibrate it over the whole frame, or take a smaller one"
                )
        self.attitude = self.attitude_sigma[:, None] * self.normals("attitude", 3)
        say_islands_left_out(self.name, self.vertices, self.starts, self.center, self.owner)
        lakes = range(len(self.center))
        self._rings = [rings_of(k, self.starts, self.owner) for k in lakes]
        self._longest = longest = max(len(i) + len(b) - 1 for i, b in self._rings)
        if longest > MOST_VERTICES:
            raise ConfigurationError(
                f"'{self.name}' sees outlines of {MOST_VERTICES} vertices at most; its catalog has "
                f"one of {longest}, islands included\n  select smaller lakes, or a coarser source"
            )
        self._moved = None
        if self.catalog_sigma.any():
            draw = self.normals("catalog", self.vertices.size).reshape(n, -1, 3)
            self._moved = self.catalog_sigma[:, None, None] * draw
        self._best = np.zeros((n, len(_BEST)))
        self._best[:, _BEST.index("angle")] = np.inf
        self._has_seen = np.zeros(n, dtype=np.bool_)

    def _extra_state(self) -> dict[str, Any]:
        return {"best": self._best, "has_seen": self._has_seen}

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        self._best, self._has_seen = saved["best"], saved["has_seen"]

    def terminate(self) -> None:
        """Say where members never had a lake in the frame, and by how much it was missed."""
        super().terminate()
        if self.step_index == 0:
            return
        rows = self.environment.active & ~self._has_seen
        if rows.any():
            _log.warning("'%s' %s", self.name, self._missed(rows))

    def _missed(self, rows: NDArray[np.bool_]) -> str:
        """What is said of members whose frame never held a lake."""
        n, whole = int(rows.sum()), int(self.environment.active.sum())
        whose = "" if whole == 1 else f" in {'any' if n == whole else n} of {whole} members"
        best = self._best[rows]
        of = best[:, _BEST.index("angle")].argmin()
        angle, distance, lake, t = best[of]
        latitude, longitude, _ = geodetic(self.center[int(lake)])
        named = (
            f"lake {int(lake)} of its catalog (latitude {np.degrees(latitude):.2f}, "
            f"longitude {np.degrees(longitude):.2f} deg)"
        )
        far = f"at t = {t:.4g} s, {distance / 1e3:,.0f} km along the ground from the point below"
        corner = np.maximum(self.principal, self.size - self.principal)[rows][of]
        reach = np.degrees(np.arctan(np.linalg.norm(corner) / self.focal[rows][of]))
        if angle > np.pi / 2:
            missed = f"all lay below the horizon or behind the camera; {named} came nearest {far}"
        else:
            missed = (
                f"the nearest, {named}, came to {np.degrees(angle):.1f} deg of the optical axis "
                f"{far}; the frame reaches {reach:.1f} deg"
            )
        return (
            f"never had a lake in the frame{whose}: {missed}\n  check the orbit and "
            f"{self.name}.earth_angle0, or select lakes under its track in the catalog"
        )

    def _step_impl(self, t: float, dt: float) -> None:
        self._look(t)

    def _look(self, t: float) -> None:
        n, longest = self.n_members, self._longest
        vertices = np.full((n, MOST_VERTICES, 2), np.nan)
        count = np.zeros(n, dtype=np.int64)
        lake, whole, share = np.zeros(n), np.zeros(n), np.zeros(n)
        C, o = ground_in_view(*self._own(np.arange(n), t))[:2]
        candidates = self._candidates(C, o)
        noise = np.empty((0, 0, 2))  # drawn only where there is something to see
        if (candidates >= 0).any():
            noise = self.normals("vertices", 2 * longest).reshape(n, longest, 2)
        for lakes in candidates.T:  # nearest first; a whole outline before any other
            for number in np.unique(lakes[lakes >= 0]):
                rows = np.flatnonzero((lakes == number) & (whole < 0.5))
                if not rows.size:  # all that could see it have a whole one already
                    continue
                pixels, inside = self._outline(number, rows, t)
                complete: NDArray[np.bool_] = np.asarray(inside.all(axis=1))
                taken = complete | ((count[rows] == 0) & inside.any(axis=1))
                own, size = rows[taken], pixels.shape[1]
                sigma = self.vertex_sigma[own, None, None]
                vertices[own, :size] = pixels[taken] + sigma * noise[own, :size]
                count[own], lake[own], whole[own] = size, number, complete[taken]
                share[own] = inside[taken].mean(axis=1)
        self._has_seen |= count > 0
        self.contour.publish(t, vertices, count=count, valid=count > 0)
        self.look.publish(
            t, valid=count > 0, lake=lake, sigma=self.vertex_sigma, whole=whole, share=share
        )
        self._remember_nearest(C, o, t)

    def _remember_nearest(self, C: FloatArray, o: FloatArray, t: float) -> None:
        """Of members that had no lake in the frame so far, what came nearest to it."""
        blind = np.flatnonzero(self.environment.active & ~self._has_seen)
        lake, angle, distance = nearest_to_axis(C[blind], o[blind], self.center)
        near = angle + distance / EARTH.radius  # pi for all that are below the horizon
        before = self._best[blind, 0] + self._best[blind, 1] / EARTH.radius
        told = np.stack([angle, distance, lake, np.full(len(blind), t)], axis=1)
        self._best[blind[near < before]] = told[near < before]

    def _own(self, rows: NDArray[np.int64], t: float) -> tuple[dict[str, Any], dict[str, Any]]:
        """What members' looks depend on: their states, and the camera's constants."""
        values = {"r": self.r_i[rows], "v": self.v_i[rows], "attitude": self.attitude[rows]}
        return values, self.looking(rows) | {"t": np.full(len(rows), t)}

    def _outline(
        self, lake: int, rows: NDArray[np.int64], t: float
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Pixels (k, K, 2) of a lake's vertices, and which of them are in the frame.

        Between rings stands a row that is not a number, and counts as in the frame.
        """
        index, begins = self._rings[lake]
        points = self.vertices[index]
        if self._moved is not None:
            points = points + self._moved[rows][:, index]
        seen = Seen(*self._own(rows, t), points, self.center[lake])
        inside = seen.depth > 0.0
        if self.clipping == "frame":
            size = self.size[rows, None]
            inside &= ((seen.pixels > -0.5) & (seen.pixels < size - 0.5)).all(axis=2)
        if len(begins) == 1:
            return seen.pixels, inside
        gaps = begins[1:]
        return np.insert(seen.pixels, gaps, np.nan, axis=1), np.insert(inside, gaps, True, axis=1)

    def _candidates(self, C: FloatArray, o: FloatArray) -> NDArray[np.int64]:
        """Lakes that may be in each member's frame, nearest to the axis first; -1 for none."""
        clipped = self.clipping == "frame"
        reach = np.linalg.norm(self.size, axis=1) / self.focal if clipped else self.focal * np.inf
        seen, across = in_view(C, o, self.center, self.radius, reach)
        seen &= self.environment.active[:, None]
        order = np.argsort(np.where(seen, across, np.inf), axis=1)[:, :_NEAREST]
        return np.where(np.take_along_axis(seen, order, axis=1), order, -1)


_NEAREST = 4
"""Lakes that are looked at in one frame."""
_BEST = ("angle", "distance", "lake", "t")
"""What came nearest to a member's frame: its angle off the axis [rad] and distance on the ground
[m]; which lake, and when [s]."""


class LakeImager(Component):
    """Images of the lake whose outline a camera sees: coverage of pixels, blurred, lit, with noise.

    Its camera gives outlines without noise. Land is all around.
    """

    default_rate = Rate("1/30")

    blur = Parameter(0.5, unit="px", minimum=0.0, doc="standard deviation of the point spread")
    water = Parameter(0.05, minimum=0.0, doc="reflectance of water")
    land = Parameter(0.25, minimum=0.0, doc="reflectance of land")
    light = Parameter(
        [0.0, 0.0], shape=(2,), doc="growth of light from the left to the right, top to bottom"
    )
    noise = Parameter(0.002, minimum=0.0, doc="standard deviation of the noise [reflectance]")
    clouds = Parameter(0.0, minimum=0.0, maximum=1.0, doc="share of the frame that they touch")
    bits = Count(12, doc="of the codes of its pixels; 0: reflectance itself")

    contour = MessageInput(**CONTOUR, doc="vertices of the lake's outline in the frame")
    look = MessageInput(fields=LOOK, doc="which lake it is, and how well it is seen")
    image = MessageOutput(**FRAME, doc="codes of the pixels")

    def _step_impl(self, t: float, dt: float) -> None:
        height, width = FRAME["shape"]
        images = np.zeros((self.n_members, height, width))
        seen = self.contour.fresh & self.look.fresh & self.environment.active
        draws = self.normals("noise", 1)[:, 0]
        for m in np.flatnonzero(seen):
            told = self.contour.value[m, : self.contour.count[m]]
            vertices, begins = split_rings(told)
            outline, *islands = np.split(vertices, begins[1:])
            rng = np.random.default_rng(draws[m : m + 1].view(np.uint64))
            look = Appearance(
                water=float(self.water[m]),
                land=float(self.land[m]),
                gradient=(float(self.light[m, 0]), float(self.light[m, 1])),
                noise=float(self.noise[m]),
                bits=self.bits,
            )
            share = float(self.clouds[m])
            opacity = cloud_opacity(width, height, share, rng) if share else None
            blur = float(self.blur[m])
            covered = render_polygon(outline, width, height, islands, blur=blur)
            images[m] = render_scene(covered, look, rng, opacity)
        self.image.publish(self.look.t, images, valid=seen)
