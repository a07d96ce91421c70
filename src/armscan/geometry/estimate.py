# SPDX-License-Identifier: Apache-2.0
"""What an estimator returns: a value with its evidence, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NoReturn, TypeVar

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, floats

T = TypeVar("T")
U = TypeVar("U")


class Estimate(ArrayRecord, Generic[T]):
    """An estimated value with its covariance and residuals.

    Parameters
    ----------
    parameter_names
        Names with units of the P free parameters, in the order of ``covariance``.
    covariance
        (P, P) covariance of the parameters.
    residuals
        Residuals at the optimum, in the unit that the estimator's docstring gives; any shape.
    degrees_of_freedom
        Count of independent observations minus count of free parameters.
    chi2
        Sum of squared residuals, each divided by its sigma.
    """

    value: T
    parameter_names: tuple[str, ...]
    covariance: FloatArray = floats("P", "P")
    residuals: FloatArray
    degrees_of_freedom: int
    chi2: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.covariance) != len(self.parameter_names):
            raise InputError(
                f"covariance of {len(self.covariance)} parameters for {len(self.parameter_names)}"
            )
        residuals = np.array(self.residuals, dtype=np.float64)
        residuals.setflags(write=False)
        object.__setattr__(self, "residuals", residuals)

    def of(self, value: U) -> Estimate[U]:
        """The same evidence for a value in another form."""
        return Estimate(
            value=value,
            parameter_names=self.parameter_names,
            covariance=self.covariance,
            residuals=self.residuals,
            degrees_of_freedom=self.degrees_of_freedom,
            chi2=self.chi2,
        )

    @property
    def sigma(self) -> FloatArray:
        """(P,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True)
class FitFailure:
    """Why there is no estimate: the fact and what to do.

    It is neither true nor false: ``first or FitFailure(...)`` would lose the reason of a first
    failure, and ``if fit`` ask an estimate that may be empty itself. Ask with `isinstance`.
    """

    reason: str
    remedy: str = ""

    def __bool__(self) -> NoReturn:
        """Raise: whether there is an estimate is asked with `isinstance`."""
        raise TypeError("a FitFailure has no truth value; ask isinstance(x, FitFailure)")
