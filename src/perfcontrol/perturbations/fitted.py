"""A perturbation that fits a problem: of its shape, and of its horizon where it varies in time."""

import math

from perfcontrol._checks import InputError, varies
from perfcontrol.perturbations.base import AbstractPerturbation


def fitted_perturbation(
    law: AbstractPerturbation, policy_shape: tuple[int, int, int], horizon: int | float
) -> AbstractPerturbation:
    """`law` with all its sizes known; raises InputError where it does not fit, or varies where nothing may."""

    def over(steps: int) -> AbstractPerturbation | InputError:
        try:
            resized = law.resize(policy_shape, steps)
            resized.check(policy_shape, steps)
        except InputError as error:
            return error
        return resized

    if not math.isinf(horizon):
        fitted = over(int(horizon))
    else:
        fitted, longer = over(1), over(2)
        errors = [answer for answer in (fitted, longer) if isinstance(answer, InputError)]
        if len({str(error) for error in errors}) == 2 or len(errors) == 1:  # a time axis shows over one step or two
            raise varies("perturbation", f"a law with a time axis ({errors[0]})")
    if isinstance(fitted, InputError):
        raise fitted
    return fitted
