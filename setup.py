"""What is packaged: every folder with an ``__init__.py`` under four roots, found, not listed."""

from setuptools import find_packages, setup

ROOTS = {
    "terrafix": "src/terrafix",
    "terrafix.components": "components",
    "terrafix.cosim": "cosim",
    "terrafix.models": "models",
}

setup(
    package_dir=ROOTS,
    packages=[
        *ROOTS,
        *(f"{root}.{room}" for root, folder in ROOTS.items() for room in find_packages(folder)),
    ],
)
