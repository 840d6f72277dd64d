"""What a filter of one's own is made of: an error state, a process, observations, four bases.

``docs/howto/a_filter_of_your_own.md`` is one from the first line to its verdict.
"""

from terrafix.components.filters.acquisition import FilterAcquisition as FilterAcquisition
from terrafix.components.filters.ensembles import EnsembleCorrect as EnsembleCorrect
from terrafix.components.filters.family import FilterCorrect as FilterCorrect
from terrafix.components.filters.family import FilterPredict as FilterPredict
from terrafix.components.filters.monitor import FilterMonitor as FilterMonitor
from terrafix.components.filters.twins import FilterSensor as FilterSensor
from terrafix.components.filters.twins import FilterTruth as FilterTruth
from terrafix.components.judges.filter_evaluation import FilterEvaluation as FilterEvaluation
from terrafix.models.filters.ensembles import EnsembleObservation as EnsembleObservation
from terrafix.models.filters.ensembles import ensemble_observation as ensemble_observation
from terrafix.models.filters.error_state import Block as Block
from terrafix.models.filters.error_state import Carried as Carried
from terrafix.models.filters.error_state import ErrorState as ErrorState
from terrafix.models.filters.error_state import clone as clone
from terrafix.models.filters.error_state import considered as considered
from terrafix.models.filters.error_state import rotation as rotation
from terrafix.models.filters.error_state import vector as vector
from terrafix.models.filters.measurement import Observation as Observation
from terrafix.models.filters.monitor import ALARMS as ALARMS
from terrafix.models.filters.process import Process as Process

__all__ = [
    *("ALARMS", "Block", "Carried", "EnsembleCorrect", "EnsembleObservation", "ErrorState"),
    *("FilterAcquisition", "FilterCorrect", "FilterEvaluation", "FilterMonitor", "FilterPredict"),
    *("FilterSensor", "FilterTruth", "Observation", "Process", "clone", "considered"),
    *("ensemble_observation", "rotation", "vector"),
]
