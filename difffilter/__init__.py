"""Robust Kalman-type filters in pure PyTorch: tuned by gradient, frozen, compared, deployed."""

from difffilter.belief import Belief, Measurement, Record, belief
from difffilter.checkpoint import Checkpoint, load, save
from difffilter.compare import Comparison, compare
from difffilter.condition import condition
from difffilter.errors import (
    CheckpointError,
    DifffilterError,
    InputError,
    LogError,
    NonFiniteError,
)
from difffilter.estimate import estimate, started
from difffilter.filter import Filter
from difffilter.gate import Gate
from difffilter.log import Log, Start, stack_logs
from difffilter.logfile import read_log, write_log
from difffilter.metrics import nees, rejected, rmse
from difffilter.motion import ConstantVelocity, FunctionMotion
from difffilter.parameters import Parameter, ParameterSet
from difffilter.recorded import load_logs
from difffilter.run import Track, run
from difffilter.scenario.document import scenario_names
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.sensor import FunctionSensor, wrap
from difffilter.sensors import TDOA, Position, PositionSensor, Range
from difffilter.simulate import simulate
from difffilter.start import from_measurements
from difffilter.step import step
from difffilter.tracker import Tracker
from difffilter.tune.loop import TuneResult, tune
from difffilter.tune.settings import TuneSettings
from difffilter.weights import WEIGHTS, Weight, huber, igg3, imq, plain, tanh

__all__ = [
    "TDOA",
    "WEIGHTS",
    "Belief",
    "Checkpoint",
    "CheckpointError",
    "Comparison",
    "ConstantVelocity",
    "DifffilterError",
    "Filter",
    "FunctionMotion",
    "FunctionSensor",
    "Gate",
    "InputError",
    "Log",
    "LogError",
    "Measurement",
    "NonFiniteError",
    "Parameter",
    "ParameterSet",
    "Position",
    "PositionSensor",
    "Range",
    "Record",
    "Scenario",
    "Start",
    "Track",
    "Tracker",
    "TuneResult",
    "TuneSettings",
    "Weight",
    "belief",
    "compare",
    "condition",
    "estimate",
    "from_measurements",
    "huber",
    "igg3",
    "imq",
    "load",
    "load_logs",
    "load_scenario",
    "nees",
    "plain",
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
    "tanh",
    "tune",
    "wrap",
    "write_log",
]
