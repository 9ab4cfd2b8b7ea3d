"""Robust Kalman-type filters in pure PyTorch: tuned by gradient, frozen, compared, deployed."""

from difffilter.adaptation import (
    Chain,
    InnovationMatching,
    MultipleFading,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.adaptation.credibility import Credibility
from difffilter.adaptation.registry import ADAPTATIONS, Host, adaptation
from difffilter.adaptation.trust import trust_gap
from difffilter.baselines.registry import BASELINES, Given, baseline
from difffilter.comparison.comparison import Comparison, compare
from difffilter.comparison.optimality import FSP, fsp, fsp_surface, ratio_gain
from difffilter.core.beliefs import Belief, Measurement, Record, belief
from difffilter.core.conditioning import condition
from difffilter.errors import (
    CheckpointError,
    DifffilterError,
    InputError,
    LogError,
    NonFiniteError,
)
from difffilter.filters.filter import Filter
from difffilter.filters.fusion import Fusion
from difffilter.filters.stepping import step
from difffilter.logs.family import Family, Member
from difffilter.logs.log import Log, Start, stack_logs
from difffilter.logs.logfile import read_log, write_log
from difffilter.logs.track import Track
from difffilter.motions.blocks import ConstantVelocity, CoordinatedTurn, FunctionMotion
from difffilter.parameters.parameters import Parameter, ParameterSet
from difffilter.robust.federation import Federation
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import Recovery
from difffilter.running.batch import run
from difffilter.running.problem import Problem
from difffilter.running.tracker import Tracker
from difffilter.scenario.checkpoint import Checkpoint, load, save
from difffilter.scenario.document import scenario_names
from difffilter.scenario.estimation import estimate, started
from difffilter.scenario.families import family
from difffilter.scenario.recorded import load_logs
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.simulation import simulate
from difffilter.scoring.losses import LOSSES, Loss, LossContext, loss
from difffilter.scoring.metrics import Score, nees, rejected, rmse
from difffilter.sensors.builtin import TDOA, Bearing, Position, PositionSensor, Range, StationSensor
from difffilter.sensors.sensor import FunctionSensor, wrap
from difffilter.start.bearings import from_bearings
from difffilter.start.measurements import from_measurements
from difffilter.tuning.loop import TuneResult, tune
from difffilter.weights.registry import (
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
    weight,
    welsch,
)

__all__ = [
    "ADAPTATIONS",
    "BASELINES",
    "FSP",
    "LOSSES",
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
    "Family",
    "Federation",
    "Filter",
    "FunctionMotion",
    "FunctionSensor",
    "Fusion",
    "Gate",
    "Given",
    "Host",
    "InnovationMatching",
    "InputError",
    "Log",
    "LogError",
    "Loss",
    "LossContext",
    "Measurement",
    "Member",
    "MultipleFading",
    "NonFiniteError",
    "Parameter",
    "ParameterSet",
    "Position",
    "PositionSensor",
    "PredictionCorrection",
    "Problem",
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
    "adaptation",
    "barron",
    "baseline",
    "belief",
    "cauchy",
    "compare",
    "condition",
    "danish",
    "estimate",
    "family",
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
    "loss",
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
    "weight",
    "welsch",
    "wrap",
    "write_log",
]
