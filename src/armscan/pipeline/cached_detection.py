# SPDX-License-Identifier: Apache-2.0
"""Targets and stripes of an image, taken from a cache where it holds them."""

from __future__ import annotations

from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.records.profile import Profile
from armscan.storage.detection_cache import DetectionCache, detection_key
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.options import StripeOptions
from armscan.vision.targets.definition import Target
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import TargetView


def cached_target(
    exposure: Exposure,
    target: Target,
    options: TargetOptions | None = None,
    cache: DetectionCache | None = None,
) -> TargetView | FitFailure:
    """As `detect_target`; looks only if the cache does not know. None for no cache."""
    chosen = TargetOptions() if options is None else options
    if cache is None:
        return detect_target(exposure, target, chosen)
    key = detection_key("target", exposure, (target, chosen))
    found = cache.get(key)
    if isinstance(found, TargetView | FitFailure):
        return found
    looked = detect_target(exposure, target, chosen)
    cache.put(key, looked)
    return looked


def cached_profile(
    exposure: Exposure,
    options: StripeOptions | None = None,
    background: Exposure | None = None,
    cache: DetectionCache | None = None,
) -> Profile:
    """As `extract_stripes`; looks only if the cache does not know. None for no cache."""
    chosen = StripeOptions() if options is None else options
    if cache is None:
        return extract_stripes(exposure, chosen, background)
    key = detection_key("stripes", exposure, (chosen,), background)
    found = cache.get(key)
    if isinstance(found, Profile):
        return found
    looked = extract_stripes(exposure, chosen, background)
    cache.put(key, looked)
    return looked
