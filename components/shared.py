"""What a component needs whose output is one for all members, published by reference."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Flag, Parameter


class OwnOrCommon(Component):
    """Base of components whose shared output is one for all members, or each member's own."""

    own = Flag(
        False, doc="each member's own, with noise of its own: members are flown one at a time"
    )

    def alone(self) -> bool:
        """Whether it is each member's own."""
        return bool(self.setting("own"))


def common(component: Component, name: str) -> FloatArray:
    """What is the same for all active members, or for all where none is left at this instant."""
    active = component.environment.active
    values = np.asarray(getattr(component, name))[active if active.any() else slice(None)]
    if active.any() and np.any(values != values[:1]):
        raise ConfigurationError(
            f"'{component.name}.{name}' differs between members, but its output is one for all\n"
            "  fly members with one truth: disperse what is known at the start and the sensors, "
            f"not the orbit, the attitude or the antenna; or {_one_at_a_time(component)}"
        )
    return np.asarray(values[0])


def _one_at_a_time(component: Component) -> str:
    if "own" in component.settings():
        return f"fly one member at a time: terrafix campaign, with {component.name}.own = true"
    return "fly one member at a time"


def generator(component: Component, member: int | None = None) -> np.random.Generator:
    """Noise of a step: of the root seed, the component and its step alone, and of a member.

    One for all members if none is named, unless the component is of one alone; a member is one of
    those flown here, by its place.
    """
    member = 0 if member is None and component.alone() else member
    env = component.environment
    words = [env.seed & 0xFFFFFFFF, env.seed >> 32, component.step_index, *env.path.encode()]
    if member is not None:
        words += [int(env.members[member]) + 1]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


def lasting_seed(component: Component) -> int:
    """Seed of what a component draws once for a run: of the root seed and the component alone."""
    env = component.environment
    words = [env.seed & 0xFFFFFFFF, env.seed >> 32, *env.path.encode()]
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def require_common(component: Component, *names: str) -> None:
    """Raise ConfigurationError if parameters differ between members; all of them by default."""
    declared = [n for n, s in component.settings().items() if isinstance(s, Parameter)]
    for name in names or declared:
        values = np.asarray(getattr(component, name))
        if np.any(values != values[:1]):
            raise ConfigurationError(
                f"'{component.name}.{name}' differs between members, but what "
                f"'{component.name}' makes with it is one for all\n"
                f"  leave it out of the dispersions, or {_one_at_a_time(component)}"
            )


def shared_setting(component: Component, name: str) -> FloatArray:
    """A numeric parameter that all members share, in a run as before it."""
    if component.lent is None:
        return np.asarray(component.setting(name))
    return np.asarray(getattr(component, name)[0])


_SAME_ANGLE = 1e-9


def foreseen_side(component: Component, other: Component | None) -> Iterator[str]:
    """Whether two that have the nominal angles of one antenna agree on them.

    Raises
    ------
    ConfigurationError
        If one looks to the right of the track, the other to the left.
    """
    for name in ("look", "squint"):
        if other is None or not {name} <= set(component.settings()) & set(other.settings()):
            continue
        own, others = (float(c.setting(name)) for c in (component, other))
        said = (
            f"'{component.name}.{name}' is {np.degrees(own):.6g} deg and '{other.name}.{name}' "
            f"{np.degrees(others):.6g} deg"
        )
        if name == "look" and own * others < 0:
            raise ConfigurationError(
                f"{said}: one looks to the other side of the track\n  set both to the same"
            )
        if abs(own - others) > _SAME_ANGLE:
            yield f"{said}: nominally they are one antenna's"


def require_earth(component: Component, earth: str, r_e: FloatArray) -> None:
    """Raise ConfigurationError if positions (n_members, 3) [m] are not of the Earth chosen."""
    distance = np.linalg.norm(r_e[component.environment.active], axis=1)
    if not len(distance) or not np.isfinite(distance).any():
        return
    far = bool(np.nanmedian(distance) > _BELOW_GROUND)
    if far == (earth == "wgs84"):
        return
    other = "wgs84" if far else "flat"
    raise ConfigurationError(
        f"'{component.name}.earth' is {earth}, but the position that it reads is "
        f"{np.nanmedian(distance) / 1e3:,.0f} km from the origin, as on the Earth '{other}'\n"
        "  set the same earth in flight, sensors, filter and evaluation"
    )


_BELOW_GROUND = 6.2e6
"""Distance from the Earth's center that no flight has [m]."""
