# SPDX-License-Identifier: Apache-2.0
"""The image in which a stripe is sought: grey or colour, laser-off subtracted, gated by colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, ImageArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.stripe.ridge import copy_cells
from armscan.models.calibration import LaserColour
from armscan.records.exposure import Exposure
from armscan.vision.stripe.ridge import (
    CELL_PX,
    SAMPLE_STEP_PX,
    FloatImage,
    ImageLevel,
    is_of_bytes,
    measure_level,
)

StripeMethod = Literal["fit", "fast", "threshold", "centroid", "template", "hessian"]
MaskImage: TypeAlias = NDArray[np.uint8]

SIGMA_RANGE_PX = (0.6, 10.0)
MOST_SMOOTHING_PX = 100.0
"""The pass that smooths holds 112 points to either side of a point."""


@dataclass(frozen=True, slots=True)
class StripeOptions:
    """Options of `extract_stripes`.

    Parameters
    ----------
    method
        ``fit`` (noise-weighted profile fit, smoothed along the line), ``fast`` (each column or row
        by itself in few passes: for lines in the dark, not on lit boards) or one of the thesis's
        four.
    laser_colour
        What of a colour image shows the line: a channel of the laser's colour; ``grey``, the mean
        of all; an excess, a channel less the mean of the two others (``green-excess``); or a
        difference of two (``green-red`` is green less red). ``auto`` finds it.
    line_sigma_px
        Sigma of the line's cross-section, or None to find it; ``fast`` always finds it.
    threshold
        Least height of a line above its background in grey levels, or None to set it from the
        image's noise.
    smoothing_px
        Largest half window of the smoothing along the line, to 100 px; 0 switches it off.
    on_print
        The lines lie on matt print, which the laser lights up as the room's light does: of ``fit``,
        the view without laser then tells how bright the ground is under the line.
    """

    method: StripeMethod = "fit"
    laser_colour: LaserColour = "auto"
    line_sigma_px: float | None = None
    threshold: float | None = None
    smoothing_px: float = 12.0
    on_print: bool = False

    def __post_init__(self) -> None:
        for name, choices in (("method", StripeMethod), ("laser_colour", LaserColour)):
            value = getattr(self, name)
            if value not in get_args(choices):
                raise OptionError(
                    f"{name} '{value}' is not known",
                    remedy=f"choose one of: {', '.join(get_args(choices))}",
                )
        low, high = SIGMA_RANGE_PX
        if self.line_sigma_px is not None and not low <= self.line_sigma_px <= high:
            raise OptionError(
                f"line_sigma_px is {self.line_sigma_px}",
                remedy=f"give {low} to {high} px, or leave it out to have it found",
            )
        if self.threshold is not None and not 0.0 < self.threshold < math.inf:
            raise OptionError(
                f"threshold is {self.threshold}", remedy="give a positive count of grey levels"
            )
        if not 0.0 <= self.smoothing_px <= MOST_SMOOTHING_PX:
            raise OptionError(
                f"smoothing_px is {self.smoothing_px}", remedy=f"give 0 to {MOST_SMOOTHING_PX:g} px"
            )


ROUNDS = 4
TRIM_SIGMAS = 2.5
GAIN_LIMITS = (0.0, 20.0)


def check_background(exposure: Exposure, background: Exposure) -> None:
    """Raise `InputError` unless both exposures show the same pixels in the same format."""
    if exposure.image.shape != background.image.shape or exposure.window != background.window:
        raise InputError(
            f"the background image is {background.image.shape} at {background.window}, the stripe "
            f"image {exposure.image.shape} at {exposure.window}",
            where=background.source,
            remedy="take both with the same camera settings",
        )


SHIFT_STEPS, SHIFT_SETTLED_PX = 8, 0.002
LEAST_SHIFT_PX, MOST_SHIFT_PX = 0.02, 2.0
"""Less leaves no edge that is seen; to more the blurred edges do not lead."""
CERTAIN_SHIFT, EXPLAINED = 6.0, 0.9
"""Sigmas to which a shift must be known, and what it may leave of the scatter at edges: colours
that a webcam makes up follow the light, and move nothing."""
LANCZOS_PX = 4
MOVE_REACH_PX = LANCZOS_PX + math.ceil(MOST_SHIFT_PX)
EDGE_BLUR_PX = 1.0
EDGE_SAMPLE, EDGE_SHARE, MOST_EDGES = 200_000, 0.2, 20_000
"""Pixels that are looked at, and the part and count of them, the steepest, that are compared."""
LEAST_EDGES = 200
LEAST_GAIN = 0.2
"""A view whose edges show by less in the other one is not the same view."""


def laid_under(background: Exposure, exposure: Exposure) -> Exposure:
    """The view without laser, moved to where the view with it was taken; itself if nothing moved.

    Between two photographs of a scene that stands still, a tripod or a board on its stand often
    moves by a tenth to a quarter of a pixel: print edges then stay in the difference as lines.
    The steepest edges of the view decide: what moves by itself before steeper ones is not seen.
    """
    shift = shift_of(background, exposure)
    if shift is None:
        return background
    image = np.rint(_moved(background.image, shift))
    image = np.clip(image, 0.0, background.full_scale).astype(background.image.dtype)
    return replace(background, image=np.ascontiguousarray(image))


def shift_of(background: Exposure, exposure: Exposure) -> FloatArray | None:
    """(2,) px by which `laid_under` moves the view without laser right and down; None for none."""
    return shift_between(_grey(exposure), _grey(background))


def shift_between(lit: FloatImage, dark: FloatImage) -> FloatArray | None:
    """(2,) px by which what the dark view (H, W) shows lies farther right and down in the lit one.

    It leaves least at the edges of the dark view (Lucas and Kanade 1981), by a trimmed fit that
    allows another brightness, so that the laser's own pixels do not count. None if that is hardly
    anything, or not certain.
    """
    lit, dark = (
        np.asarray(cv2.GaussianBlur(image, (0, 0), EDGE_BLUR_PX), np.float32)
        for image in (lit, dark)
    )
    every = max(1, math.isqrt(dark.size // EDGE_SAMPLE))
    v, u = _steepest(dark, every)
    if not len(u):
        return None
    level, shift, unmoved = lit[v, u].astype(np.float64), np.zeros(2), np.inf
    for k in range(SHIFT_STEPS):
        there = dark if k == 0 else _moved(dark, shift)
        across = 0.5 * (there[v, u + 1] - there[v, u - 1])
        down = 0.5 * (there[v + 1, u] - there[v - 1, u])
        design = np.stack([there[v, u], np.ones(len(u)), across, down], axis=1, dtype=np.float64)
        if k == 0:
            unmoved = _trimmed_fit(design[:, :2], level).scatter
        fit = _trimmed_fit(design, level)
        if not fit.terms[0] > LEAST_GAIN:
            return None
        step = -fit.terms[2:] / fit.terms[0]
        shift = shift + step
        if not np.abs(shift).max() < MOST_SHIFT_PX or np.abs(shift).max() < 0.5 * LEAST_SHIFT_PX:
            return None
        if np.abs(step).max() < SHIFT_SETTLED_PX:
            break
    # pixels that are nearer to each other than the blur is wide share their noise
    shared = max(1.0, 2.0 * math.sqrt(math.pi) * EDGE_BLUR_PX / every)
    sigma_px = shared * fit.sigmas[2:] / fit.terms[0]
    shift = np.where(np.abs(shift) > CERTAIN_SHIFT * sigma_px, shift, 0.0)
    is_told = np.linalg.norm(shift) > LEAST_SHIFT_PX and fit.scatter < EXPLAINED * unmoved
    return shift if is_told else None


def _moved(image: ImageArray | FloatImage, shift: FloatArray) -> FloatImage:
    """An image (H, W) or (H, W, 3), float32, moved by (2,) px right and down.

    By Lanczos' kernel: with OpenCV's cubic one a shift of 0.25 px is found as 0.21 px.
    """
    at = np.arange(-MOVE_REACH_PX, MOVE_REACH_PX + 1.0)
    kernels = np.sinc(at + shift[:, None]) * np.sinc((at + shift[:, None]) / LANCZOS_PX)
    kernels[np.abs(at + shift[:, None]) >= LANCZOS_PX] = 0.0
    across, down = kernels / kernels.sum(axis=1, keepdims=True)
    levels = np.asarray(image, np.float32)
    moved = cv2.sepFilter2D(levels, cv2.CV_32F, across, down, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)


def _steepest(image: FloatImage, every: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the steepest of ``every`` so many pixels, none of them at the border."""
    border = MOVE_REACH_PX + 1
    inside = slice(border, -border, every)
    slope = np.hypot(*(cv2.Scharr(image, -1, *along)[inside, inside] for along in ((1, 0), (0, 1))))
    count = min(int(EDGE_SHARE * slope.size), MOST_EDGES)
    if count < LEAST_EDGES:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    chosen = np.argpartition(slope, -count, axis=None)[-count:]
    v, u = np.divmod(np.sort(chosen), slope.shape[1])
    return np.asarray(border + every * v), np.asarray(border + every * u)


class _TrimmedFit(NamedTuple):
    """Terms (K,) of linear least squares, their standard deviations, and what values scatter by."""

    terms: FloatArray
    sigmas: FloatArray
    scatter: float


def _trimmed_fit(design: FloatArray, values: FloatArray) -> _TrimmedFit:
    """Linear least squares without outliers."""
    use = np.ones(len(values), dtype=np.bool_)
    for _ in range(ROUNDS):
        normal = design[use].T @ design[use]
        terms = np.linalg.lstsq(normal, design[use].T @ values[use], rcond=None)[0]
        rest = values - design @ terms
        scatter = max(robust_sigma(rest[use]), 1e-6)
        sigmas = scatter * np.sqrt(np.maximum(np.diag(np.linalg.pinv(normal)), 0.0))
        use = np.abs(rest) <= TRIM_SIGMAS * scatter
    return _TrimmedFit(np.asarray(terms), np.asarray(sigmas), robust_sigma(rest))


def _grey(exposure: Exposure) -> FloatImage:
    """(H, W) float32 mean of the channels, as the image has them."""
    image = exposure.image
    return np.asarray(image if image.ndim == 2 else image.mean(axis=2), dtype=np.float32)


def subtract(lit: FloatImage, dark: FloatImage, full_scale: float) -> FloatImage:
    """Subtract the dark view after matching its brightness.

    Gain and offset come from a trimmed line fit over a sample of unsaturated pixels, so that a lamp
    that flickers between the two images leaves no ghost, and the laser's own pixels do not count.

    ``lit``, ``dark``: (H, W) float32, laser on and off. ``full_scale``: Grey level of saturation.
    """
    x = dark[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX].ravel().astype(np.float64)
    y = lit[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX].ravel().astype(np.float64)
    use = (x < 0.98 * full_scale) & (y < 0.98 * full_scale)
    gain, offset = 1.0, 0.0
    for _ in range(ROUNDS):
        if use.sum() < 16:
            break
        middle = x[use].mean()
        squares = float(((x[use] - middle) ** 2).sum())
        if squares > use.sum():
            slope = float(((x[use] - middle) * y[use]).sum()) / squares
            gain = float(np.clip(slope, *GAIN_LIMITS))
        offset = float(np.median(y[use] - gain * x[use]))
        rest = np.abs(y - gain * x - offset)
        use = rest <= TRIM_SIGMAS * max(robust_sigma(rest), 0.5)
    return np.asarray(lit - np.float32(gain) * dark - np.float32(offset), dtype=np.float32)


DIM, BRIGHT, LEAST_BETWEEN = 0.1, 0.9, 0.02
"""Of full scale. A lens and a sensor leave 40 to 100 % of the pixels that are not dark between the
two (photographs of ten strangers, over-exposed ones among them), a threshold none."""
FEW_PX = 32
BLACK, BLOCK_PX, LEAST_GREY, LEAST_WHITE_PX = 0.03, 8, 0.001, 40
"""What a threshold made black stays so, but for the ripples of JPEG in the blocks beside white: not
so a dim line beside a glint or a window. Less white than a line's is some hot pixels."""
SOFT_PX = 1.0
ROUNDED_PX = math.sqrt(1.0 / 24.0)
"""Scatter of the mean of two edges, each rounded to a whole pixel."""


def is_thresholded(exposure: Exposure) -> bool:
    """True of a grey image that somebody made black and white: hardly a pixel lies between.

    Of others a few rows and columns tell.
    """
    image, full_scale = exposure.image, exposure.full_scale
    if image.ndim > 2:
        return False
    few = (image[::FEW_PX], image[:, ::FEW_PX].copy())
    is_so = _is_black_and_white(few, full_scale)
    is_so = is_so and _is_black_and_white((image,), full_scale, LEAST_WHITE_PX)
    return is_so and _is_black_elsewhere(image, full_scale)


def _is_black_elsewhere(image: ImageArray, full_scale: int) -> bool:
    """Whether what is far from white pixels is black."""
    is_white = (image >= int(BRIGHT * full_scale)).view(np.uint8)
    near = cv2.dilate(is_white, np.ones((2 * BLOCK_PX + 1, 2 * BLOCK_PX + 1), np.uint8))
    n_grey = np.count_nonzero((image > int(BLACK * full_scale)) & (near == 0))
    return bool(n_grey <= LEAST_GREY * np.count_nonzero(is_white))


def _is_black_and_white(parts: Sequence[ImageArray], full_scale: int, least: int = 0) -> bool:
    n_lit = sum(np.count_nonzero(part > int(DIM * full_scale)) for part in parts)
    n_white = sum(np.count_nonzero(part >= int(BRIGHT * full_scale)) for part in parts)
    return bool(n_white >= least and n_lit - n_white <= LEAST_BETWEEN * n_lit)


def softened(exposure: Exposure) -> Exposure:
    """A grey exposure with flanks on its lines, of which a fit lives: blurred by a pixel."""
    image = np.empty_like(exposure.image)
    cv2.GaussianBlur(exposure.image, (0, 0), SOFT_PX, dst=image)
    return replace(exposure, image=image)


EVEN = np.ones((1, 1), np.float32)
PEAK_QUANTILE = 0.999
LOST_SIGMAS = 3.0
GROUND_PX = 5
"""Within such squares noise of the view without laser is told from the print."""
TELLING_PX = 2
"""Of every second pixel of every second row, quantiles of an image are told."""
WHITE_QUANTILE = 0.95
FLATTEST = 0.1
FLATTEST_VARIANCE = 0.65
"""Such a share of squares that hold noise alone shows less than that of its variance (chi square of
24 degrees of freedom): small dots leave fewer flat squares than edges."""
LEAST_WHITE_SIGMAS = 10.0
DARKEST = 0.02
"""Black print reflects 3 % and more of what white paper does."""


def local_moments(image: FloatImage) -> tuple[FloatImage, FloatImage]:
    """Mean and variance (H, W) of an image in the square of `GROUND_PX` around each pixel."""
    mean, square = (
        np.asarray(
            cv2.blur(power, (GROUND_PX, GROUND_PX), borderType=cv2.BORDER_REFLECT), np.float32
        )
        for power in (image, image * image)
    )
    return mean, np.maximum(square - mean * mean, np.float32(1e-3))


def less_noise(
    image: FloatImage, mean: FloatImage, variance: FloatImage, noise: FloatImage | float
) -> FloatImage:
    """An image (H, W) without its noise of this variance; an edge stays as it is (Lee 1980).

    ``mean``, ``variance``: its `local_moments`.
    """
    keep = np.maximum(1.0 - noise / variance, 0.0)
    return np.asarray(mean + keep * (image - mean), np.float32)


def relative_reflectance(background: Exposure, colour: str) -> FloatImage:
    """Reflectance (H, W) of the ground relative to its brightest, from the view without laser.

    Where a square of pixels differs by no more than noise, its mean is taken (Lee 1980); an edge
    stays as it is. (1, 1) where the view is too dark to say anything. ``colour``: As in
    `StripeOptions.laser_colour`; of ``auto``, the mean of the channels is taken.
    """
    if background.colour == "mono":
        dark = _level(background, None, None)
    else:
        first = colour.partition("-")[0]
        own = [CHANNELS.index(first)] if first in CHANNELS else range(3)
        levels = [_level(background, None, k) for k in own]
        dark = np.asarray(sum(levels) / np.float32(len(levels)), dtype=np.float32)
    mean, variance = local_moments(dark)
    means, variances = (moment[::TELLING_PX, ::TELLING_PX] for moment in (mean, variance))
    white = float(np.quantile(means, WHITE_QUANTILE))
    if not white > 0.0:
        return EVEN
    is_light = means > 0.5 * white
    flattest = np.quantile(variances[is_light] / np.maximum(means[is_light], 1e-3), FLATTEST)
    per_level = float(flattest) / FLATTEST_VARIANCE
    if white < LEAST_WHITE_SIGMAS**2 * per_level:
        return EVEN
    ground = less_noise(dark, mean, variance, per_level * mean) / np.float32(white)
    return np.ascontiguousarray(np.maximum(ground, DARKEST), dtype=np.float32)


NORMAL_SCALE = 255.0
"""Grey levels are scaled to 8 bits, so that no constant depends on the camera's depth."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StripePlane:
    """One channel of an exposure, ready for extraction; a mask is (1, 1) if it holds nowhere.

    ``image``: (H, W), full scale 255 before background subtraction. ``clipped``: (H, W) 1 where
    ``image`` says nothing because the camera saturated. ``saturated``: (H, W) 1 where the laser's
    own channel saturated. ``grey_levels_per_unit``: Factor from ``image`` to the exposure's own
    grey levels. ``gate``: (H, W) how much the pixel has the laser's colour, or None for grey
    images. ``unknown``: (H, W) 1 where the view without laser saturated already; None without such
    a view. ``reflectance``: (H, W) of the ground relative to the brightest, (1, 1) if it is not
    known.
    """

    image: FloatImage
    clipped: MaskImage
    saturated: MaskImage
    grey_levels_per_unit: float
    gate: FloatImage | None = None
    unknown: MaskImage | None = None
    reflectance: FloatImage = field(default_factory=lambda: EVEN)

    def on_even_ground(self, image: FloatImage, noise: float) -> FloatImage:
        """What an image (H, W) of the laser's light would be on ground that is bright everywhere.

        Where the ground is so dark that the light is lost in the ``noise``, it stays dark.
        """
        if self.reflectance.size == 1:
            return image
        peak = max(float(np.quantile(image[::TELLING_PX, ::TELLING_PX], PEAK_QUANTILE)), noise)
        least = np.float32((LOST_SIGMAS * noise / peak) ** 2)
        return np.asarray(image * self.reflectance / (self.reflectance**2 + least))

    def with_black(self, black: float) -> StripePlane:
        """The same with a reflectance that is smaller by ``black`` everywhere."""
        ground = np.maximum(self.reflectance - np.float32(black), np.float32(DARKEST))
        return replace(self, reflectance=ground)


def _saturated(channel: ImageArray, full_scale: int) -> MaskImage:
    """Mask (H, W) of clipped pixels, or (1, 1) zeros if there are none."""
    if int(channel.max()) < full_scale:
        return np.zeros((1, 1), np.uint8)
    return np.ascontiguousarray(channel >= full_scale).view(np.uint8)


def _level(exposure: Exposure, background: Exposure | None, k: int | None) -> FloatImage:
    """A channel scaled to 255, less the background's; ``k`` None for a grey image."""
    scale = np.float32(NORMAL_SCALE / exposure.full_scale)
    image = _channel(exposure, k).astype(np.float32) * scale
    if background is None:
        return image
    return subtract(image, _level(background, None, k), NORMAL_SCALE)


def _channel(exposure: Exposure, k: int | None) -> ImageArray:
    return exposure.image if k is None else exposure.image[:, :, k].copy()


def _unknown(background: Exposure | None, k: int | None) -> MaskImage | None:
    if background is None:
        return None
    return _saturated(_channel(background, k), background.full_scale)


def mono_plane(exposure: Exposure, background: Exposure | None) -> StripePlane:
    """Plane of a grey exposure, less the background."""
    clipped = _saturated(exposure.image, exposure.full_scale)
    return StripePlane(
        image=_level(exposure, background, None),
        clipped=clipped,
        saturated=clipped,
        grey_levels_per_unit=exposure.full_scale / NORMAL_SCALE,
        unknown=_unknown(background, None),
    )


NOWHERE = np.zeros((1, 1), np.uint8)
FILLED_CELLS = 2
"""Around lit cells, copied too: as far as a filter, a fit and the background beside it look."""


def lit_plane(exposure: Exposure, threshold: float | None) -> tuple[StripePlane, ImageLevel]:
    """Plane of a grey exposure of which only what lies near lines is copied, and its level.

    Farther away its image is 0. ``threshold``: As for `measure_level`, of full scale 255.
    """
    scale = NORMAL_SCALE / exposure.full_scale
    raw = exposure.image
    level = measure_level(raw, threshold, scale)
    near = maximum_filter(level.lit, 2 * FILLED_CELLS + 1, mode="constant")
    image = np.zeros(raw.shape, np.float32)
    if is_of_bytes(raw):
        copy_cells(raw, near, CELL_PX, scale, image)
    else:
        _copy_deep_cells(raw, near, scale, image)
    is_clipped = level.brightest >= exposure.full_scale
    clipped = (raw >= exposure.full_scale).view(np.uint8) if is_clipped else NOWHERE
    units = exposure.full_scale / NORMAL_SCALE
    plane = StripePlane(image=image, clipped=clipped, saturated=clipped, grey_levels_per_unit=units)
    return plane, level


def _copy_deep_cells(
    raw: ImageArray, near: NDArray[np.uint8], scale: float, image: FloatImage
) -> None:
    """As `copy_cells`, of images of more than eight bits."""
    for row, cells in enumerate(near):
        edges = np.flatnonzero(np.diff(cells, prepend=0, append=0)) * CELL_PX
        for left, right in zip(edges[::2], edges[1::2], strict=True):
            own = np.s_[row * CELL_PX : (row + 1) * CELL_PX, left:right]
            np.multiply(raw[own], np.float32(scale), out=image[own], casting="unsafe")


CHANNELS = ("red", "green", "blue")
COLOURS: tuple[LaserColour, ...] = ("red", "green", "blue")
RIDGE_STEP_PX = 14
RIDGE_QUANTILE = 0.9995
LEAST_COLOUR_SHARE = 0.25
"""A laser's colour shows at least this share of the grey contrast, else the line is grey."""
SATURATED_SHARE = 0.12
"""With more clipped pixels on the line than this, another channel is consulted."""
LEAST_CORE_HEIGHT = 8.0
"""A channel shows the core if it rises by this much above its surroundings there."""
LINE_SHARE = 0.4
LEAST_WHITE = 0.03
FLAT_RISE = 50.0
"""White cores are looked at if they cover this share of the line, and their channel is filled if it
rises by no more of 255: by 0 to 47 in 40 photographs of six strangers, 61 to 200 in 30 others."""


@dataclass(frozen=True, slots=True, eq=False)
class ColourImages:
    """Red, green and blue (H, W) after background subtraction, and their saturated pixels."""

    channels: tuple[FloatImage, ...]
    clipped: tuple[MaskImage, ...]


def split_channels(exposure: Exposure, background: Exposure | None) -> ColourImages:
    """Red, green and blue of an exposure, less the background."""
    return ColourImages(
        tuple(_level(exposure, background, k) for k in range(3)),
        tuple(_saturated(_channel(exposure, k), exposure.full_scale) for k in range(3)),
    )


def colour_excess(images: ColourImages, colour: str) -> FloatImage:
    """How much stronger the laser's colour is than the mean of the two others, (H, W)."""
    k = CHANNELS.index(colour)
    others = [images.channels[m] for m in range(3) if m != k]
    return np.asarray(images.channels[k] - np.float32(0.5) * (others[0] + others[1]))


def ridge_height(image: FloatImage) -> FloatImage:
    """Height (H - 2 s, W - 2 s) above both neighbours at distance s, along rows or columns."""
    s = RIDGE_STEP_PX
    if min(image.shape) <= 2 * s:
        return np.zeros((0, 0), np.float32)
    middle = image[s:-s, s:-s]
    along_row = middle - np.maximum(image[s:-s, : -2 * s], image[s:-s, 2 * s :])
    down_column = middle - np.maximum(image[: -2 * s, s:-s], image[2 * s :, s:-s])
    return np.asarray(np.maximum(along_row, down_column))


def _strength(image: FloatImage) -> float:
    ridge = ridge_height(image)
    return float(np.quantile(ridge, RIDGE_QUANTILE)) if ridge.size else 0.0


def line_strengths(images: ColourImages) -> list[float]:
    """Height in grey levels of the strongest thin lines that red, green and blue excess form."""
    return [_strength(colour_excess(images, colour)) for colour in COLOURS]


def find_laser_colour(images: ColourImages) -> LaserColour:
    """Colour whose excess forms the strongest thin lines; grey if none stands out."""
    strengths = line_strengths(images)
    grey = _strength(np.asarray(sum(images.channels) / np.float32(3.0)))
    best = int(np.argmax(strengths))
    return COLOURS[best] if strengths[best] > LEAST_COLOUR_SHARE * grey else "grey"


def colour_planes(
    exposure: Exposure, background: Exposure | None, colour: LaserColour
) -> tuple[StripePlane, ...]:
    """The plane of a colour exposure in which the stripe is sought, or two to choose from.

    Of ``auto``, the colour is found in this one image. For a colour, the laser's own channel is
    used; where its core is saturated, the least saturated channel that still shows the core is
    added: it rises where the first has reached its limit, while the halo and dim parts of the line
    stay with the laser's colour; only ridges with the laser's colour around them count. Where the
    line's own glow fills its channel, the two others come first: they show what is over-exposed,
    and nothing of the line where it is dim. For a difference, what the channels have in common, the
    room's light on a printed pattern, cancels.
    """
    images = split_channels(exposure, background)
    factor = exposure.full_scale / NORMAL_SCALE
    if colour == "auto":
        colour = find_laser_colour(images)
    if colour == "grey":
        mean = np.asarray(sum(images.channels) / np.float32(3.0), dtype=np.float32)
        found = [mask for mask in images.clipped if mask.size > 1]
        anywhere = np.maximum.reduce(found) if found else NOWHERE
        return (
            StripePlane(
                image=mean, clipped=anywhere, saturated=anywhere, grey_levels_per_unit=factor
            ),
        )
    own = CHANNELS.index(colour.partition("-")[0])
    gate = colour_excess(images, colour) if colour in CHANNELS else None
    if gate is None:
        shown = [(_difference(images, colour), images.clipped[own])]
    else:
        shown = _shown_line(images, gate, own)
    return tuple(
        StripePlane(
            image=image,
            clipped=clipped,
            saturated=images.clipped[own],
            grey_levels_per_unit=factor,
            gate=gate,
            unknown=_unknown(background, own),
        )
        for image, clipped in shown
    )


def _difference(images: ColourImages, colour: LaserColour) -> FloatImage:
    """One channel less another one, or less the mean of both others."""
    first, _, second = colour.partition("-")
    if second == "excess":
        return colour_excess(images, first)
    return images.channels[CHANNELS.index(first)] - images.channels[CHANNELS.index(second)]


def _shown_line(
    images: ColourImages, excess: FloatImage, own: int
) -> list[tuple[FloatImage, MaskImage]]:
    """(H, W) sums of channels that may show the line, and where they no longer rise."""
    image, clipped = images.channels[own], images.clipped[own]
    s = RIDGE_STEP_PX
    ridge = ridge_height(excess)
    if not ridge.size or clipped.size == 1:
        return [(image, clipped)]
    least = LINE_SHARE * float(np.quantile(ridge, RIDGE_QUANTILE))
    line, full = ridge > least, clipped[s:-s, s:-s] > 0
    halo = line & full
    shown = [(image, clipped)]
    is_clipped = halo.sum() > SATURATED_SHARE * line.sum()
    if is_clipped and (core := _core_channel(images, halo, own)) is not None:
        shown = [(image + images.channels[core], images.clipped[core])]
    first, second = (k for k in range(3) if k != own)
    others = images.channels[first] + images.channels[second]
    # a core that is white has no excess
    white = full & (ridge_height(others) > least)
    if white.sum() > LEAST_WHITE * line.sum() and _is_flat(image, white):
        flat = np.minimum(images.clipped[first], images.clipped[second])
        shown.insert(0, (others, flat))
    return shown


def _is_flat(image: FloatImage, where: BoolArray) -> bool:
    """True where a saturated channel hardly rises: the halo beside the line has filled it, too."""
    return float(np.median(ridge_height(image)[where])) < FLAT_RISE


def _core_channel(images: ColourImages, core: BoolArray, own: int) -> int | None:
    """The channel that shows a core in which the laser's own is saturated; None if none does."""
    s = RIDGE_STEP_PX
    heights = [float(np.median(ridge_height(c)[core])) for c in images.channels]
    shares = [float(m[s:-s, s:-s][core].mean()) if m.size > 1 else 0.0 for m in images.clipped]
    others = [k for k in range(3) if k != own and heights[k] > LEAST_CORE_HEIGHT]
    return min(others, key=lambda k: (shares[k], -heights[k])) if others else None
