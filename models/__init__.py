"""Mathematics of terrain-relative navigation: no ports, no clock.

Symbolic models (`terrafix.Model`) are written once in CasADi; their derivatives are derived,
their kernels and FMUs generated. Everything else takes arrays and returns arrays.
"""
