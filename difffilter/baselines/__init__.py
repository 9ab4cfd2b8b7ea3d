"""Estimators to compare with: without memory, on Chan's solution, or with adapted noise."""

from difffilter.adaptation.scaling import InnovationScaling
from difffilter.baselines.bearing_lines import BearingLeastSquares
from difffilter.baselines.chan_ekf import ChanEKF
from difffilter.baselines.closed_form import ChanLeastSquares, chan
from difffilter.baselines.least_squares import TaylorLeastSquares, gauss_newton

__all__ = [
    "BearingLeastSquares",
    "ChanEKF",
    "ChanLeastSquares",
    "InnovationScaling",
    "TaylorLeastSquares",
    "chan",
    "gauss_newton",
]
