"""Co-simulation of terrain-relative navigation.

``terrafix.cosim`` steps systems of components, ``terrafix.components`` holds the components of
navigation, ``terrafix.models`` the mathematics in them.
"""

from __future__ import annotations

__all__ = ["__version__"]


def __getattr__(name: str) -> str:
    if name == "__version__":  # looked up on demand: reading the metadata costs milliseconds
        from importlib.metadata import version

        return version("terrafix")
    raise AttributeError(f"module 'terrafix' has no attribute '{name}'")
