"""Parameters declared once, physical outside, unconstrained inside."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import assert_close, number, tensor

from difffilter.errors import InputError
from difffilter.parameters.constraints import Covariance, OrderedPair, Positive, Real, Simplex
from difffilter.parameters.parameters import (
    Parameter,
    ParameterSet,
    as_number,
    check_values,
    declare,
    published_values,
)

DECLARED = declare(
    [
        Parameter("noise.sigma", 3.0, Positive(), "m", tuned=True, prior=0.1),
        Parameter("tanh.ab", (1.5, 4.0), OrderedPair(), tuned=True, labels=("a", "b")),
        Parameter("sensor.bias", (0.0, 0.5), Real(), "m"),
        Parameter("mix", (0.25, 0.75), Simplex()),
        Parameter("q", ((2.0, 0.5), (0.5, 1.0)), Covariance()),
    ]
)


def test_a_new_set_holds_the_published_values() -> None:
    values = ParameterSet(DECLARED).values()
    assert list(values) == list(DECLARED)
    for name, published in published_values(DECLARED).items():
        assert_close(values[name] + 1, published + 1, 1e-14)


def test_given_values_replace_the_published_ones() -> None:
    given = {"noise.sigma": tensor(7.0), "sensor.bias": tensor([1.0, -1.0])}
    values = ParameterSet(DECLARED, given).values()
    assert number(values["noise.sigma"]) == pytest.approx(7.0)
    assert torch.equal(values["sensor.bias"], tensor([1.0, -1.0]))
    assert torch.equal(values["mix"], tensor([0.25, 0.75]))


def test_the_optimiser_sees_the_tuned_parameters_only_and_unconstrained() -> None:
    parameters = ParameterSet(DECLARED)
    free = parameters.free()
    assert list(free) == ["noise.sigma", "tanh.ab"]
    assert number(free["noise.sigma"]) == pytest.approx(math.log(3.0))
    assert_close(free["tanh.ab"], tensor([math.log(1.5), math.log(2.5)]), 1e-14)
    assert {id(p) for p in parameters.parameters()} == {id(p) for p in free.values()}


def test_a_step_of_the_optimiser_moves_the_physical_value_and_stays_admissible() -> None:
    parameters = ParameterSet(DECLARED)
    with torch.no_grad():
        for raw in parameters.free().values():
            raw -= 5.0
    values = parameters.values()
    assert number(values["noise.sigma"]) == pytest.approx(3.0 * math.exp(-5.0))
    check_values(DECLARED, values)


def test_gradients_reach_the_tuned_parameters_and_no_other() -> None:
    parameters = ParameterSet(DECLARED)
    values = parameters.values()
    (3 * values["noise.sigma"] + values["tanh.ab"].sum()).backward()
    free = parameters.free()
    assert_close(free["noise.sigma"].grad, tensor(9.0), 1e-14)
    assert_close(free["tanh.ab"].grad, tensor([3.0, 2.5]), 1e-14)
    assert not any(values[name].requires_grad for name in ("sensor.bias", "mix", "q"))


def test_frozen_values_are_detached_copies() -> None:
    parameters = ParameterSet(DECLARED)
    frozen = parameters.frozen_values()
    frozen["sensor.bias"] += 100.0
    assert not any(value.requires_grad for value in frozen.values())
    assert torch.equal(parameters.values()["sensor.bias"], tensor([0.0, 0.5]))


def test_with_tuned_gives_a_copy_at_the_same_values() -> None:
    parameters = ParameterSet(DECLARED, {"noise.sigma": tensor(7.0)})
    changed = parameters.with_tuned("mix", True).with_tuned("noise.sigma", False)
    assert list(changed.free()) == ["tanh.ab", "mix"]
    assert list(parameters.free()) == ["noise.sigma", "tanh.ab"]
    for name, value in parameters.values().items():
        assert_close(changed.values()[name] + 1, value + 1, 1e-14)


@pytest.mark.parametrize("name", list(DECLARED))
def test_every_parameter_can_be_tuned_and_frozen_in_float32(name: str) -> None:
    parameters = ParameterSet(DECLARED, dtype=torch.float32)
    for other in DECLARED:
        parameters = parameters.with_tuned(other, False)
    tuned = parameters.with_tuned(name, True)
    assert list(tuned.free()) == [name]
    again = tuned.with_tuned(name, False).values()[name]
    assert again.dtype == torch.float32
    assert_close(again.double() + 1, DECLARED[name].tensor() + 1, 1e-6)


def test_an_unknown_name_is_an_input_error() -> None:
    with pytest.raises(InputError, match=r"noise\.sgima: no such parameter.*noise\.sigma"):
        ParameterSet(DECLARED, {"noise.sgima": tensor(1.0)})
    with pytest.raises(InputError, match=r"noise\.sgima: no such parameter"):
        ParameterSet(DECLARED).with_tuned("noise.sgima", True)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("noise.sigma", -1.0, "a number above 0"),
        ("noise.sigma", [1.0, 2.0], r"found shape \[2\], expected \[\]"),
        ("tanh.ab", [4.0, 1.5], "0 < a < b"),
        ("q", [[1.0, 2.0], [2.0, 1.0]], "positive definite"),
        ("mix", [0.5, 0.6], "sum to 1"),
        ("sensor.bias", [0.0, math.nan], "finite"),
    ],
)
def test_a_wrong_value_is_an_input_error_that_names_it(
    name: str, value: object, message: str
) -> None:
    with pytest.raises(InputError, match=rf"^{name}: .*{message}"):
        ParameterSet(DECLARED, {name: tensor(value)})  # type: ignore[arg-type]


def test_the_same_name_twice_must_be_the_same_declaration() -> None:
    one = Parameter("k", 1.0, Positive())
    assert list(declare([one, Parameter("k", 1.0, Positive())])) == ["k"]
    with pytest.raises(InputError, match="k: declared twice"):
        declare([one, Parameter("k", 2.0, Positive())])


def test_a_published_value_outside_its_own_set_is_an_input_error() -> None:
    with pytest.raises(InputError, match="k: found 0"):
        declare([Parameter("k", 0.0, Positive())])


def test_the_prior_is_a_normal_in_unconstrained_numbers_about_the_published_value() -> None:
    assert number(ParameterSet(DECLARED).negative_log_prior()) == pytest.approx(0.0, abs=1e-20)
    parameters = ParameterSet(DECLARED, {"noise.sigma": tensor(3.0 * math.exp(0.2))})
    loss = parameters.negative_log_prior()
    assert number(loss) == pytest.approx(0.5 * (0.2 / 0.1) ** 2)
    loss.backward()
    free = parameters.free()
    assert_close(free["noise.sigma"].grad, tensor(0.2 / 0.1**2), 1e-12)
    assert free["tanh.ab"].grad is None


def test_a_frozen_parameter_has_no_prior() -> None:
    parameters = ParameterSet(DECLARED, {"noise.sigma": tensor(9.0)})
    assert number(parameters.with_tuned("noise.sigma", False).negative_log_prior()) == 0.0


def test_entries_name_each_number() -> None:
    assert DECLARED["noise.sigma"].entries() == ["noise.sigma"]
    assert DECLARED["tanh.ab"].entries() == ["tanh.ab.a", "tanh.ab.b"]
    assert DECLARED["sensor.bias"].entries() == ["sensor.bias[0]", "sensor.bias[1]"]
    assert DECLARED["q"].entries() == ["q[0,0]", "q[0,1]", "q[1,0]", "q[1,1]"]


def test_as_number_turns_tensors_and_lists_into_nested_tuples() -> None:
    assert as_number(tensor([[1.0, 2.0], [3.0, 4.0]])) == ((1.0, 2.0), (3.0, 4.0))
    assert as_number([1, 2]) == (1.0, 2.0)
    assert as_number(3) == 3.0


def test_the_old_name_of_with_tuned_says_the_new_one() -> None:
    with pytest.raises(InputError, match=r"with_tuned\('mix', True\), which gives a copy"):
        ParameterSet(DECLARED).set_tuned("mix", True)


def test_integers_are_real_numbers() -> None:
    given = ParameterSet(DECLARED, {"noise.sigma": torch.tensor(3)}).values()["noise.sigma"]
    assert given.dtype == torch.float64
    assert float(given.detach()) == pytest.approx(3.0, rel=1e-15)
    with pytest.raises(InputError, match=r"found torch.bool, expected a tensor of real"):
        ParameterSet(DECLARED, {"noise.sigma": torch.tensor(True)})
