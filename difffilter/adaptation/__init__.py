"""Plug-ins around predict and condition; each works with any linearisation and any weight."""

from difffilter.adaptation.chain import Chain
from difffilter.adaptation.correction import PredictionCorrection
from difffilter.adaptation.fading import MultipleFading, StrongTracking
from difffilter.adaptation.matching import InnovationMatching

__all__ = [
    "Chain",
    "InnovationMatching",
    "MultipleFading",
    "PredictionCorrection",
    "StrongTracking",
]
