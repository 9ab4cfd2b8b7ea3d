"""Robust Kalman-type filters in pure PyTorch: tuned by gradient, frozen, compared, deployed."""

from difffilter.adaptation import (
    Chain,
    InnovationMatching,
    MultipleFading,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.belief import Belief, Measurement, Record, belief
from difffilter.checkpoint import Checkpoint, load, save
from difffilter.compare import Comparison, compare
from difffilter.condition import condition
from difffilter.credibility import Credibility
from difffilter.errors import (
    CheckpointError,
    DifffilterError,
    InputError,
    LogError,
    NonFiniteError,
)
from difffilter.estimate import estimate, started
from difffilter.federation import Federation
from difffilter.filter import Filter
from difffilter.fsp import FSP, fsp, fsp_surface, ratio_gain
from difffilter.fusion import Fusion
from difffilter.gate import Gate
from difffilter.log import Log, Start, stack_logs
from difffilter.logfile import read_log, write_log
from difffilter.metrics import Score, nees, rejected, rmse
from difffilter.motion import ConstantVelocity, CoordinatedTurn, FunctionMotion
from difffilter.parameters import Parameter, ParameterSet
from difffilter.recorded import load_logs
from difffilter.recovery import Recovery
from difffilter.run import Track, run
from difffilter.scenario.document import scenario_names
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.sensor import FunctionSensor, wrap
from difffilter.sensors import TDOA, Bearing, Position, PositionSensor, Range, StationSensor
from difffilter.simulate import simulate
from difffilter.start import from_measurements
from difffilter.step import step
from difffilter.tracker import Tracker
from difffilter.triangulate import from_bearings
from difffilter.trust import trust_gap
from difffilter.tune.loop import TuneResult, tune
from difffilter.tune.settings import TuneSettings
from difffilter.weights import (
    WEIGHTS,
    Weight,
    barron,
    cauchy,
    danish,
    huber,
    igg3,
    imq,
    plain,
    student_t,
    tanh,
    tukey,
    welsch,
)

__all__ = [
    "FSP",
    "TDOA",
    "WEIGHTS",
    "Bearing",
    "Belief",
    "Chain",
    "Checkpoint",
    "CheckpointError",
    "Comparison",
    "ConstantVelocity",
    "CoordinatedTurn",
    "Credibility",
    "DifffilterError",
    "Federation",
    "Filter",
    "FunctionMotion",
    "FunctionSensor",
    "Fusion",
    "Gate",
    "InnovationMatching",
    "InputError",
    "Log",
    "LogError",
    "Measurement",
    "MultipleFading",
    "NonFiniteError",
    "Parameter",
    "ParameterSet",
    "Position",
    "PositionSensor",
    "PredictionCorrection",
    "Range",
    "Record",
    "Recovery",
    "Scenario",
    "Score",
    "Start",
    "StationSensor",
    "StrongTracking",
    "Track",
    "Tracker",
    "TuneResult",
    "TuneSettings",
    "Weight",
    "barron",
    "belief",
    "cauchy",
    "compare",
    "condition",
    "danish",
    "estimate",
    "from_bearings",
    "from_measurements",
    "fsp",
    "fsp_surface",
    "huber",
    "igg3",
    "imq",
    "load",
    "load_logs",
    "load_scenario",
    "nees",
    "plain",
    "ratio_gain",
    "read_log",
    "rejected",
    "rmse",
    "run",
    "save",
    "scenario_names",
    "simulate",
    "stack_logs",
    "started",
    "step",
    "student_t",
    "tanh",
    "trust_gap",
    "tukey",
    "tune",
    "welsch",
    "wrap",
    "write_log",
]
