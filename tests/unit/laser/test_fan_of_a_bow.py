# SPDX-License-Identifier: Apache-2.0
"""Where a sheet's rays come from, found from its bow; and left alone where that makes it worse."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from armscan.calibration.sheets.model import _OneSheet
from armscan.models.light_sheet import BOW_TERMS, LightSheet
from rigs.instrument_stages import run_camera, run_sheets
from rigs.instruments import draw_instrument

U2, UV, U3, U2V = (BOW_TERMS.index(term) for term in ((2, 0), (1, 1), (3, 0), (2, 1)))
FLAT = LightSheet(
    origin_mm=np.array([0.0, 0.0, 130.0]), axes=np.eye(3), scale_mm=25.0, bow_mm=np.zeros(5)
)
N_CAMERA = 9


class _Stated(_OneSheet):
    """A sheet whose fits are told: ``bow_mm`` along the stripe, and what the light's rays do."""

    told: tuple

    def __init__(self, bow_mm: float, sigma_mm: float, chi2_of_fan) -> None:
        errors = SimpleNamespace(n_camera=N_CAMERA)
        super().__init__(None, errors, is_bow_allowed=True)
        object.__setattr__(self, "told", (bow_mm, sigma_mm, chi2_of_fan))

    def solve(self, start, sigma_factor, *, is_bowed=False, may_bow=False):
        bow_mm, sigma_mm, chi2_of_fan = self.told
        bow = np.zeros(5)
        bow[U2] = bow_mm
        # light that spreads by 0.2 leaves, of rays taken for parallel, -0.2 u^2 v of the bow, and
        # light that leans by 0.1 -0.3 u^2 v of what goes with u^3
        bow[U3] = 0.3 * bow_mm
        bow[UV] = 2.0 * bow_mm * (start.fan[0] - 0.1)
        bow[U2V] = bow_mm * (start.fan[1] - 0.2) + 3.0 * bow[U3] * (start.fan[0] - 0.1)
        return SimpleNamespace(
            sheets=(replace(start, bow_mm=bow),),
            chi2=chi2_of_fan(start.fan),
            covariance=sigma_mm**2 * np.eye(N_CAMERA + 8),
        )


def test_a_strong_bow_shows_its_fan() -> None:
    sheet = _Stated(0.1, 1e-5, lambda fan: 1e4 * float(((fan - [0.1, 0.2]) ** 2).sum()))
    found = sheet.solve_bowed(FLAT, 1.0)
    np.testing.assert_allclose(found.sheets[0].fan, [0.1, 0.2], atol=1e-3)


def test_a_fan_that_explains_the_stripes_worse_is_not_followed() -> None:
    """A bow of 6 um misleads by its noise: chi2 grows, and the fan stays where it fits best."""
    sheet = _Stated(0.006, 1e-5, lambda fan: 1e3 * float((fan**2).sum()))
    found = sheet.solve_bowed(FLAT, 1.0)
    assert np.array_equal(found.sheets[0].fan, [0.0, 0.0])
    assert found.chi2 == 0.0


def test_the_fan_of_light_that_leans_is_where_its_source_is() -> None:
    """Cones whose rays lean by two thirds: a ray through ``(u, 0)`` comes from the source."""
    made = draw_instrument(8200079)
    camera = run_camera(made)
    sheets = run_sheets(made, camera.calibration, camera.information)
    assert sheets.fit is not None and sheets.outcome.result == "right"
    for found, light in zip(sheets.fit.sheets, sheets.names, strict=True):
        sheet = found.sheet
        u, v = sheet.axes[:2] @ (made.lights[light].source - sheet.origin_mm) / sheet.scale_mm
        np.testing.assert_allclose(sheet.fan, [u / v, -1.0 / v], atol=0.1)
