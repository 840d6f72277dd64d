"""Orbits as others write them: OEM, SP3, EOF and tables, each read to one ephemeris."""
