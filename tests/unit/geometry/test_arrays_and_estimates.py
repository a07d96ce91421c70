# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import frozen_floats
from armscan.geometry.estimate import Estimate, FitFailure


def test_frozen_arrays_are_copies_in_row_order() -> None:
    source = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    frozen = frozen_floats(source, (None, 3), "points")
    source[0, 0] = 99.0
    assert frozen[0, 0] == 0.0
    assert frozen.flags.c_contiguous
    assert not frozen.flags.writeable


@pytest.mark.parametrize("shape", [(2,), (None,), (3, 2), (None, 4)])
def test_wrong_shapes_are_named(shape: tuple[int | None, ...]) -> None:
    with pytest.raises(InputError, match=r"points_mm has shape \(2, 3\), expected"):
        frozen_floats(np.zeros((2, 3)), shape, "points_mm")


def test_nan_and_infinity() -> None:
    with pytest.raises(InputError, match="holds 1 value that is not finite"):
        frozen_floats([1.0, np.nan], (2,), "x")
    assert np.isnan(frozen_floats([1.0, np.nan], (2,), "x", allow_nan=True)[1])
    with pytest.raises(InputError, match="not finite"):
        frozen_floats([1.0, np.inf], (2,), "x", allow_nan=True)


def test_estimate_checks_its_covariance_and_gives_sigmas() -> None:
    estimate = Estimate(
        value="value",
        parameter_names=("a_mm", "b_mm"),
        covariance=np.diag([4.0, 9.0]),
        residuals=np.zeros(3),
        degrees_of_freedom=1,
        chi2=0.0,
    )
    assert estimate.sigma.tolist() == [2.0, 3.0]
    with pytest.raises(InputError, match="covariance"):
        Estimate(
            value="value",
            parameter_names=("a_mm",),
            covariance=np.eye(2),
            residuals=np.zeros(3),
            degrees_of_freedom=1,
            chi2=0.0,
        )


def test_a_failure_is_neither_true_nor_false() -> None:
    """``first or FitFailure(...)`` would lose the first reason."""
    first = FitFailure("too few points")
    with pytest.raises(TypeError, match="isinstance"):
        _ = first or FitFailure("another reason")
