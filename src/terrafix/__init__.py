"""Navigation without GPS: built of components, flown in simulation, judged, and handed on.

``import terrafix as tf`` offers what a user writes; each name is imported when it is first used.
What is listed in `__all__` stays stable, the modules it comes from may not.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from terrafix import components as components
    from terrafix import filters as filters
    from terrafix import testing as testing
    from terrafix.components.filters.smoothing import SmoothedRun as SmoothedRun
    from terrafix.components.filters.smoothing import smooth_run as smooth_run
    from terrafix.cosim.basics.clock import Rate as Rate
    from terrafix.cosim.basics.errors import CheckpointError as CheckpointError
    from terrafix.cosim.basics.errors import ConfigurationError as ConfigurationError
    from terrafix.cosim.basics.errors import EpochError as EpochError
    from terrafix.cosim.basics.errors import RateError as RateError
    from terrafix.cosim.basics.errors import StepError as StepError
    from terrafix.cosim.basics.errors import SystemCheckError as SystemCheckError
    from terrafix.cosim.basics.errors import TerrafixError as TerrafixError
    from terrafix.cosim.basics.errors import WiringError as WiringError
    from terrafix.cosim.campaign.campaign import CampaignError as CampaignError
    from terrafix.cosim.campaign.campaign import run_campaign as run_campaign
    from terrafix.cosim.campaign.results import CampaignResult as CampaignResult
    from terrafix.cosim.campaign.statistics.ensemble import STATISTICS as STATISTICS
    from terrafix.cosim.campaign.statistics.statistic import Statistic as Statistic
    from terrafix.cosim.declare.component import Component as Component
    from terrafix.cosim.declare.evaluation import Evaluation as Evaluation
    from terrafix.cosim.declare.evaluation import Quantity as Quantity
    from terrafix.cosim.declare.parameters import Choice as Choice
    from terrafix.cosim.declare.parameters import Count as Count
    from terrafix.cosim.declare.parameters import FilePath as FilePath
    from terrafix.cosim.declare.parameters import FileTable as FileTable
    from terrafix.cosim.declare.parameters import Flag as Flag
    from terrafix.cosim.declare.parameters import OptionalFilePath as OptionalFilePath
    from terrafix.cosim.declare.parameters import Parameter as Parameter
    from terrafix.cosim.declare.parameters import Table as Table
    from terrafix.cosim.declare.parameters import Text as Text
    from terrafix.cosim.declare.ports import BundleInput as BundleInput
    from terrafix.cosim.declare.ports import BundleOutput as BundleOutput
    from terrafix.cosim.declare.ports import Capabilities as Capabilities
    from terrafix.cosim.declare.ports import Input as Input
    from terrafix.cosim.declare.ports import MessageInput as MessageInput
    from terrafix.cosim.declare.ports import MessageOutput as MessageOutput
    from terrafix.cosim.declare.ports import Output as Output
    from terrafix.cosim.declare.ports import SharedInput as SharedInput
    from terrafix.cosim.declare.ports import SharedOutput as SharedOutput
    from terrafix.cosim.declare.ports import State as State
    from terrafix.cosim.declare.ports import WindowInput as WindowInput
    from terrafix.cosim.engine.result import Result as Result
    from terrafix.cosim.engine.run import RunError as RunError
    from terrafix.cosim.engine.run import simulate as simulate
    from terrafix.cosim.engine.simulation import Simulation as Simulation
    from terrafix.cosim.exchange.fmi.check.check import check_fmu as check_fmu
    from terrafix.cosim.exchange.fmi.write.export import export_fmu as export_fmu
    from terrafix.cosim.files.readers import read_system as read_system
    from terrafix.cosim.files.writing import write_system as write_system
    from terrafix.cosim.kernels.symbolic import SymbolicComponent as SymbolicComponent
    from terrafix.cosim.lincov.deviations import linear_covariance as linear_covariance
    from terrafix.cosim.lincov.prediction import LinearCovariance as LinearCovariance
    from terrafix.cosim.memory.fields import Field as Field
    from terrafix.cosim.records.results import read_result as read_result
    from terrafix.cosim.system.dispersion import Dispersion as Dispersion
    from terrafix.cosim.system.system import System as System
    from terrafix.models.core.model import Model as Model

    __version__: str

_FROM = {
    "System": "cosim.system.system",
    "Component": "cosim.declare.component",
    "SymbolicComponent": "cosim.kernels.symbolic",
    "Evaluation": "cosim.declare.evaluation",
    "Quantity": "cosim.declare.evaluation",
    "Model": "models.core.model",
    "Rate": "cosim.basics.clock",
    "Dispersion": "cosim.system.dispersion",
    "Input": "cosim.declare.ports",
    "Output": "cosim.declare.ports",
    "BundleInput": "cosim.declare.ports",
    "BundleOutput": "cosim.declare.ports",
    "MessageInput": "cosim.declare.ports",
    "MessageOutput": "cosim.declare.ports",
    "WindowInput": "cosim.declare.ports",
    "SharedInput": "cosim.declare.ports",
    "SharedOutput": "cosim.declare.ports",
    "State": "cosim.declare.ports",
    "Capabilities": "cosim.declare.ports",
    "Field": "cosim.memory.fields",
    "Parameter": "cosim.declare.parameters",
    "Choice": "cosim.declare.parameters",
    "Count": "cosim.declare.parameters",
    "Flag": "cosim.declare.parameters",
    "Text": "cosim.declare.parameters",
    "Table": "cosim.declare.parameters",
    "FilePath": "cosim.declare.parameters",
    "OptionalFilePath": "cosim.declare.parameters",
    "FileTable": "cosim.declare.parameters",
    "simulate": "cosim.engine.run",
    "RunError": "cosim.engine.run",
    "Simulation": "cosim.engine.simulation",
    "Result": "cosim.engine.result",
    "read_system": "cosim.files.readers",
    "write_system": "cosim.files.writing",
    "read_result": "cosim.records.results",
    "run_campaign": "cosim.campaign.campaign",
    "CampaignError": "cosim.campaign.campaign",
    "CampaignResult": "cosim.campaign.results",
    "STATISTICS": "cosim.campaign.statistics.ensemble",
    "Statistic": "cosim.campaign.statistics.statistic",
    "smooth_run": "components.filters.smoothing",
    "SmoothedRun": "components.filters.smoothing",
    "linear_covariance": "cosim.lincov.deviations",
    "LinearCovariance": "cosim.lincov.prediction",
    "export_fmu": "cosim.exchange.fmi.write.export",
    "check_fmu": "cosim.exchange.fmi.check.check",
    "TerrafixError": "cosim.basics.errors",
    "ConfigurationError": "cosim.basics.errors",
    "WiringError": "cosim.basics.errors",
    "EpochError": "cosim.basics.errors",
    "RateError": "cosim.basics.errors",
    "CheckpointError": "cosim.basics.errors",
    "StepError": "cosim.basics.errors",
    "SystemCheckError": "cosim.basics.errors",
}
"""Where each name comes from."""
_MODULES = ("components", "filters", "testing")

__all__ = sorted([*_FROM, *_MODULES, "__version__"])


def __getattr__(name: str) -> object:
    if name in _FROM:
        found = getattr(import_module(f"terrafix.{_FROM[name]}"), name)
    elif name in _MODULES:
        found = import_module(f"terrafix.{name}")
    elif name == "__version__":  # looked up on demand: reading the metadata costs milliseconds
        from importlib.metadata import version

        found = version("terrafix")
    else:
        from terrafix.cosim.basics.errors import nearest

        raise AttributeError(f"terrafix has no '{name}'\n  {nearest(name, __all__)}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return list(__all__)
