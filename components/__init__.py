"""Components of terrain-relative navigation: a model plus ports, state and a rate.

``tf.components.imu`` is the class that system files name ``type = "imu"``; types of installed
packages are found here, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from terrafix.cosim.declare.component import Component


def __getattr__(name: str) -> type[Component]:
    from terrafix.cosim.basics.errors import nearest
    from terrafix.cosim.declare.registry import component_entries, component_type

    if name not in component_entries():
        raise AttributeError(
            f"terrafix.components has no '{name}'\n"
            f"  {nearest(name, component_entries(), what='component types')}"
        )
    globals()[name] = found = component_type(name)
    return found


def __dir__() -> list[str]:
    from terrafix.cosim.declare.registry import component_entries

    return sorted(component_entries())
