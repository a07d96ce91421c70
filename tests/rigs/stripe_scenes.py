# SPDX-License-Identifier: Apache-2.0
"""Stripe scenes with known truth, and what an extraction did with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.records.profile import Profile
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions
from rigs.stripe_image import SimulatedStripe, StraightCurve, StripeScene

FALSE_PX = 1.0
"""A third of the line's sigma: no noise of these scenes reaches it."""


@dataclass(frozen=True)
class Score:
    """Errors of the accepted points over several seeds."""

    error_px: FloatArray
    normalised: FloatArray
    false: int
    completeness: float
    profiles: tuple[Profile, ...]

    @property
    def rms_px(self) -> float:
        return float(np.sqrt((self.error_px**2).mean()))


def line(angle_deg: float, **kw: float) -> SimulatedStripe:
    return SimulatedStripe(StraightCurve(160.3, 120.2, angle_deg), **kw)


def score(
    scene: StripeScene, seeds: range, options: StripeOptions | None = None, length_px: float = 0.0
) -> Score:
    """Extract the scene once per seed; ``length_px`` is the length of line that should be found."""
    errors, normalised, false, found, profiles = [], [], 0, 0, []
    for seed in seeds:
        profile = extract_stripes(scene.expose(seed), options)
        profiles.append(profile)
        good = profile.select(profile.is_accepted)
        distance, _, along = scene.errors(good.points_px)
        true = np.abs(distance) < FALSE_PX
        false += int((~true).sum())
        errors.append(distance[true])
        normalised.append((distance / good.sigma_px)[true])
        found += len(np.unique(np.floor(along[true] / 2.0)))
    completeness = found * 2.0 / (length_px * len(seeds)) if length_px else np.nan
    return Score(
        np.concatenate(errors), np.concatenate(normalised), false, completeness, tuple(profiles)
    )
