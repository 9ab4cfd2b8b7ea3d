"""What a scenario's parameter leaves out is as the component declares it."""

from __future__ import annotations

from dataclasses import replace

from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter
from difffilter.scenario.systems import ParameterSpec

OWN = Parameter("a.b", 1.0, Positive(), tuned=True, prior=0.3)
SPEC = ParameterSpec("parameters.a.b", 2.0, "", "", tuned=None, prior=None)


def test_tuned_and_prior_are_the_components_unless_said() -> None:
    declared = SPEC.declare(OWN)
    assert (declared.value, declared.tuned, declared.prior) == (2.0, True, 0.3)
    declared = replace(SPEC, tuned=False, prior=0.1).declare(OWN)
    assert (declared.tuned, declared.prior) == (False, 0.1)
