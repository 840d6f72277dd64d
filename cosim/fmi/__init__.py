"""Functional Mock-up Units: export of symbolic components, import and checks of anybody's."""
