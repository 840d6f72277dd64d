"""Namespaces and annotation types of SSP packages."""

SSD = "http://ssp-standard.org/SSP1/SystemStructureDescription"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"
SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
SSB = "http://ssp-standard.org/SSP1/SystemStructureSignalDictionary"
SSM = "http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
OSP = "http://opensimulationplatform.com/SSP/OSPAnnotations"
OMS = "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd"
OWN = "urn:terrafix:ssp"

PREFIXES = {"ssd": SSD, "ssc": SSC, "ssv": SSV, "ssm": SSM, "ssb": SSB, "osp": OSP, "oms": OMS}
"""As everybody writes them."""

TERRAFIX = "org.terrafix"
OPENMODELICA = "org.openmodelica"
OPEN_SIMULATION = "com.opensimulationplatform"


def tag(namespace: str, name: str) -> str:
    """A qualified name, as ElementTree has it."""
    return f"{{{namespace}}}{name}"
