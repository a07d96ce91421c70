# SPDX-License-Identifier: Apache-2.0
"""Rigid alignments of two sets of markers: from triangles to all markers that they explain."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.frames import Frame
from armscan.geometry.poses import Pose
from armscan.geometry.registration import closed_form_pose, spread_mm
from armscan.markers.distance_labels import LabelledMarkers
from armscan.markers.match_result import Alignment

REFINEMENTS = 6
SAME_PLACE_GATES = 3.0
"""Two alignments are one if they carry every marker that they explain to within so many gates."""


class MarkerPlacing:
    """Carries the second set onto the first and says which markers agree.

    Parameters
    ----------
    first, second
        The sets.
    sigmas
        A marker agrees within this many standard deviations of the difference, those of the
        alignment included.
    """

    def __init__(self, first: LabelledMarkers, second: LabelledMarkers, sigmas: float) -> None:
        self.first, self.second = first, second
        self._sigmas = sigmas
        self._tree = cKDTree(first.points_mm)
        self._sigma_mm = float(np.hypot(first.sigma_mm.max(), second.sigma_mm.max()))

    @property
    def gate_mm(self) -> float:
        """Distance within which two markers agree under a perfect alignment."""
        return self._sigmas * self._sigma_mm

    def poses(self, corners: IntArray, copies: IntArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (H, 3, 3) and translations (H, 3) from triangles (H, 3) in both sets.

        Proper rotations only (eq. 2.50 with its determinant): a mirror image is none.
        """
        target, source = self.first.points_mm[corners], self.second.points_mm[copies]
        middle_a, middle_b = target.mean(axis=1), source.mean(axis=1)
        h = np.swapaxes(source - middle_b[:, None], 1, 2) @ (target - middle_a[:, None])
        u, _, vt = np.linalg.svd(h)
        v, ut = np.swapaxes(vt, 1, 2), np.swapaxes(u, 1, 2)
        v[:, :, 2] *= np.linalg.det(v @ ut)[:, None]
        rotation = v @ ut
        return rotation, middle_a - np.einsum("hij,hj->hi", rotation, middle_b)

    def counts(self, rotation: FloatArray, translation: FloatArray, copies: IntArray) -> IntArray:
        """(H,) markers that each of H alignments explains, generously: see `refined`."""
        moved = self.second.points_mm @ np.swapaxes(rotation, 1, 2) + translation[:, None]
        reach = self._reach_mm(self.second.points_mm[copies])
        limit = float(reach.max(initial=0.0))
        distance, nearest = self._nearest(moved, limit)
        found = distance < reach
        n = len(self.first)
        hit = np.zeros((len(rotation), n + 1), dtype=bool)
        rows = np.nonzero(found)[0]
        hit[rows, nearest[found]] = True
        return np.asarray(hit[:, :n].sum(axis=1), dtype=np.int64)

    def refined(self, rotation: FloatArray, translation: FloatArray, copy: IntArray) -> Alignment:
        """The alignment that a triangle leads to: pairs and motion in turn until they agree."""
        pose: Pose[Frame, Frame] = Pose(rotation, translation)
        reach = self._reach_mm(self.second.points_mm[copy][None])[0]
        pairs = self._mutual(pose, reach)
        for _ in range(REFINEMENTS):
            if len(pairs) < 3:
                break
            target, source = self.first.points_mm[pairs[:, 0]], self.second.points_mm[pairs[:, 1]]
            variance = (
                self.first.sigma_mm[pairs[:, 0]] ** 2 + self.second.sigma_mm[pairs[:, 1]] ** 2
            )
            pose = closed_form_pose(target, source, 1.0 / variance)
            again = self._mutual(pose, self._reach_mm(source[None])[0])
            if np.array_equal(again, pairs):
                break
            pairs = again
        return Alignment(pairs, pose)

    def are_same(self, one: Alignment, other: Alignment) -> bool:
        """True if both carry all markers that they explain to the same places, or one is a part."""
        if _is_subset(one.pairs, other.pairs) or _is_subset(other.pairs, one.pairs):
            return True
        of_both = np.union1d(one.pairs[:, 1], other.pairs[:, 1])
        points = self.second.points_mm[of_both]
        a, b = one.first_from_second, other.first_from_second
        apart = points @ (a.rotation - b.rotation).T + a.translation_mm - b.translation_mm
        limit = SAME_PLACE_GATES * self.gate_mm
        return bool(np.linalg.norm(apart, axis=1).max(initial=0.0) < limit)

    def _mutual(self, pose: Pose[Frame, Frame], reach_mm: FloatArray) -> IntArray:
        """(K, 2) pairs of markers that are nearest to each other, within ``reach_mm`` (M,)."""
        moved = self.second.points_mm @ pose.rotation.T + pose.translation_mm
        distance, nearest = self._nearest(moved, np.inf)
        back = np.asarray(cKDTree(moved).query(self.first.points_mm[nearest])[1])
        kept = (distance < reach_mm) & (back == np.arange(len(moved)))
        pairs = np.stack([nearest[kept], np.flatnonzero(kept)], axis=1)
        return np.asarray(pairs[np.argsort(pairs[:, 0])], dtype=np.int64)

    def _nearest(self, points_mm: FloatArray, limit_mm: float) -> tuple[FloatArray, IntArray]:
        """Distance to the nearest marker of the first set, and its index; N beyond the limit."""
        distance, nearest = self._tree.query(points_mm, distance_upper_bound=limit_mm)
        return np.asarray(distance), np.asarray(nearest, dtype=np.int64)

    def _reach_mm(self, used_mm: FloatArray) -> FloatArray:
        """(H, M) gates of all markers of the second set under alignments through (H, K, 3) points.

        A marker's own noise, and a bound of the alignment's: its shift, and its turn about the
        points' middle, which the extent across their longest axis determines.
        """
        middle = used_mm.mean(axis=1, keepdims=True)
        squares = np.linalg.svd(used_mm - middle, compute_uv=False) ** 2
        across = np.maximum(squares[:, 1] + squares[:, 2], 1e-12)
        lever = ((self.second.points_mm[None] - middle) ** 2).sum(axis=2)
        share = 1.0 / used_mm.shape[1] + lever / across[:, None]
        return np.asarray(self.gate_mm * np.sqrt(1.0 + share))


def agree_with_known(corners: IntArray, copies: IntArray, known: list[Alignment]) -> BoolArray:
    """(H,) True where a triangle's three pairs all belong to one known alignment."""
    found = np.zeros(len(corners), dtype=bool)
    for alignment in known:
        size = int(max(corners.max(initial=0), alignment.pairs[:, 0].max(initial=0))) + 1
        partner = np.full(size, -1, dtype=np.int64)
        partner[alignment.pairs[:, 0]] = alignment.pairs[:, 1]
        found |= (partner[corners] == copies).all(axis=1)
    return found


def keeps_side(first: LabelledMarkers, translation: FloatArray, flat_below_mm: float) -> BoolArray:
    """(H,) whether a flat set is seen from one side in both frames, both of them a sensor's.

    A flat set and its mirror image differ by half a turn only. A camera stands in the origin of
    its frame and sees markers from their front, so half a turn that would show it their back is
    none. True throughout where the set is not flat.
    """
    points = first.points_mm
    if spread_mm(points)[2] > flat_below_mm:
        return np.ones(len(translation), dtype=bool)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    here = float(normal @ middle)
    return np.asarray(here * ((middle - translation) @ normal) > 0.0)


def _is_subset(part: IntArray, whole: IntArray) -> bool:
    return {(int(i), int(k)) for i, k in part} <= {(int(i), int(k)) for i, k in whole}
