# SPDX-License-Identifier: Apache-2.0
"""What a command left behind as a tree of plain values, and the comparison of two such trees.

Keys that begin with ``~`` hold prose: a difference there is shown as a warning only.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

KEPT_WHOLE = 40
N_SAMPLES = 12
VOLATILE = re.compile(
    r"(^|_)(created|created_utc|time_utc|date|armscan_version|host|hostname|python|platform|elapsed|"
    r"elapsed_s|duration_s|seconds|sha256|hash|document_id|parent_ids|command|hashes|written_by|"
    r"image_hashes|digest|size_bytes|bytes)$"
)
MASKS = (
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|\+\d\d:?\d\d| UTC)?"), "<time>"),
    (re.compile(r"\d{4}-\d\d-\d\d"), "<date>"),
    (re.compile(r"\b[0-9a-f]{32,64}\b"), "<hash>"),
    (re.compile(r"\b[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\b"), "<id>"),
    (re.compile(r"\b\d+\.\d+ s\b"), "<time>"),
    (re.compile(r"armscan \d+\.\d+\S*"), "armscan <version>"),
)

# anything that JSON can hold
Tree = Any
Sigma = float | dict[str, float]


def masked(text: str, workspace: Path) -> str:
    text = text.replace(str(workspace.resolve()), "<w>").replace(str(workspace), "<w>")
    for pattern, word in MASKS:
        text = pattern.sub(word, text)
    return text


def plain(value: Tree, workspace: Path, key: str = "") -> Tree:
    """The same tree without what changes by itself; long lists of numbers are summed up."""
    if VOLATILE.search(key) or (key == "found" and "numpy" in str(value)):
        return "<volatile>"
    if isinstance(value, dict):
        return {str(k): plain(v, workspace, str(k)) for k, v in value.items()}
    if isinstance(value, str):
        return masked(value, workspace)
    if isinstance(value, list):
        array = as_array(value)
        is_long = array is not None and array.size > KEPT_WHOLE
        return summed_up(array) if is_long else [plain(v, workspace) for v in value]
    is_odd = isinstance(value, float) and not math.isfinite(value)
    return repr(value) if is_odd else value


def as_array(value: list[Tree]) -> np.ndarray | None:
    try:
        array = np.array(value)
    except ValueError:
        return None
    return array if array.dtype.kind in "iuf" else None


def summed_up(array: np.ndarray) -> Tree:
    """Shape, moments and evenly spread samples of an array; columns stay columns."""
    flat = array.reshape(len(array), -1) if array.ndim > 1 else array.reshape(-1, 1)
    if flat.shape[1] > 15:
        flat = array.reshape(-1, 1)
    flat = np.asarray(flat, dtype=float)
    rows = np.unique(np.linspace(0, len(flat) - 1, N_SAMPLES).astype(int)) if len(flat) else []
    is_number = np.isfinite(flat)
    safe = np.where(is_number, flat, 0.0)
    return {
        "shape": list(array.shape),
        "n_finite": int(is_number.sum()),
        "mean": safe.mean(axis=0).tolist() if len(flat) else [],
        "rms": np.sqrt((safe**2).mean(axis=0)).tolist() if len(flat) else [],
        "sample": [[v if math.isfinite(v) else repr(v) for v in flat[k].tolist()] for k in rows],
    }


def read_ply(path: Path) -> dict[str, Tree]:
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode().splitlines()
    types = {"double": "<f8", "float": "<f4", "int": "<i4", "uchar": "u1", "uint": "<u4"}
    types |= {"short": "<i2", "ushort": "<u2", "char": "i1"}
    fields = [(w[2], types[w[1]]) for w in map(str.split, header) if w[0] == "property"]
    n = next(int(w[2]) for w in map(str.split, header) if w[:2] == ["element", "vertex"])
    if any("ascii" in line for line in header if line.startswith("format")):
        values = np.array(data[end:].split(), dtype=float).reshape(n, len(fields))
        columns = {name: values[:, k] for k, (name, _) in enumerate(fields)}
    else:
        rows = np.frombuffer(data, np.dtype(fields), n, end)
        columns = {name: rows[name] for name, _ in fields}
    comments = sorted(line for line in header if line.startswith("comment"))
    cloud = {name: summed_up(column) for name, column in columns.items()}
    return {"n": n, "comments": comments, "columns": cloud}


def read_npz(path: Path, workspace: Path) -> dict[str, Tree]:
    tree: dict[str, Tree] = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            array = arrays[name]
            if array.dtype.kind in "iufb" and array.size > KEPT_WHOLE:
                tree[name] = summed_up(array.astype(float))
            else:
                tree[name] = plain(array.tolist(), workspace, name)
    return tree


def read_html(path: Path) -> dict[str, Tree]:
    text = path.read_text("utf-8")
    headings = re.findall(r"<h[12][^>]*>(.*?)</h[12]>", text, flags=re.S)
    return {
        "is_alone": not re.search(r'(?:src|href)="(?!data:|#)', text),
        "~pictures": text.count("<svg") + text.count("<img"),
        "~headings": [re.sub(r"<[^>]+>|\s+", " ", heading).strip() for heading in headings],
    }


def read_text(path: Path, workspace: Path) -> Tree:
    """A table or configuration: its numbers, and its words as prose."""
    text = masked(path.read_text("utf-8", errors="replace"), workspace)
    numbers = re.findall(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])", text)
    words = [line for line in text.splitlines() if re.search(r"[A-Za-z]{3}", line)][:12]
    tree = plain([float(n) for n in numbers], workspace)
    return {"numbers": tree, "~words": words}


def read_image(path: Path) -> Tree:
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return {"shape": list(image.shape), "pixels": summed_up(image.astype(float).reshape(-1))}


def read_result(path: Path, workspace: Path) -> Tree:
    kind = path.suffix.lower()
    if kind == ".json":
        return plain(json.loads(path.read_text("utf-8")), workspace)
    if kind == ".ply":
        return plain(read_ply(path), workspace)
    if kind == ".npz":
        return read_npz(path, workspace)
    if kind == ".html":
        return plain(read_html(path), workspace)
    if kind in (".png", ".jpg", ".bmp", ".pgm"):
        return read_image(path)
    return read_text(path, workspace)


@dataclass(frozen=True)
class Difference:
    """One value that is not what it was."""

    where: str
    old: Tree
    new: Tree
    is_warning: bool
    relative: float = math.inf
    sigmas: float | None = None

    @property
    def rank(self) -> float:
        """How bad it is: in sigmas where they are known, else relative."""
        return self.relative if self.sigmas is None else self.sigmas

    def __str__(self) -> str:
        word = "warning" if self.is_warning else "DIFFERS"
        size = "" if math.isinf(self.relative) else f"  {self.relative:.1e} of it"
        size += "" if self.sigmas is None else f", {self.sigmas:.1e} sigmas"
        return f"{word}  {self.where}{size}\n    old {short(self.old)}\n    new {short(self.new)}"


def told(found: list[Difference], *, is_whole: bool, n_worst: int = 4) -> str:
    """The differences case by case, the worst of each first, the rest counted."""
    cases: dict[str, list[Difference]] = {}
    for difference in found:
        word = "warnings" if difference.is_warning else "differ"
        cases.setdefault(f"{'/'.join(difference.where.split('/')[:2])} {word}", []).append(
            difference
        )
    lines = []
    for case, members in cases.items():
        members.sort(key=lambda d: -d.rank)
        kept = members if is_whole else members[:n_worst]
        lines += [str(difference) for difference in kept]
        if len(kept) < len(members):
            lines.append(f"... {case}: {len(members) - len(kept)} more that are smaller (--all)")
    return "\n".join(lines)


def short(value: Tree) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) < 400 else text[:400] + " ..."


@dataclass(frozen=True)
class Limits:
    """How near two numbers must be.

    ``relative`` to the larger one of the two, or to the largest of its list; ``of_sigma`` is the
    part of the value's own standard deviation, where the tree tells it (None: not used).
    """

    relative: float = 1e-9
    of_sigma: float | None = None


def differences(
    old: Tree, new: Tree, limits: Limits, where: str = "", *, scale: float = 0.0, sigma: Sigma = 0.0
) -> Iterator[Difference]:
    """Everything in ``old`` that ``new`` lacks or holds otherwise; what is new is a warning."""
    is_prose = "~" in where
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old:
            place = f"{where}/{key}"
            if key not in new:
                # which options are written down may change; what they were may not
                is_free = "~" in place or "/provenance/options/" in place
                yield Difference(place, old[key], "(gone)", is_free)
                continue
            given = sigma.get(key, 0.0) if isinstance(sigma, dict) else sigma
            own = given or known_sigma(old, key)
            yield from differences(old[key], new[key], limits, place, scale=scale, sigma=own)
        for key in new.keys() - old.keys():
            yield Difference(f"{where}/{key}", "(none)", new[key], is_warning=True)
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield Difference(where, old, new, is_prose)
            return
        array = as_array([v for v in old if not isinstance(v, str)])
        scale = max([scale, *np.abs(array).ravel()[:10000]]) if array is not None else scale
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from differences(a, b, limits, f"{where}[{k}]", scale=scale, sigma=sigma)
    elif is_number(old) and is_number(new):
        part = sigma if isinstance(sigma, float) else 0.0
        allowed = limits.relative * max(abs(old), abs(new), scale) + 1e-13
        if limits.of_sigma is not None and part:
            allowed = max(allowed, limits.of_sigma * part)
        if abs(old - new) > allowed:
            largest = max(abs(old), abs(new), scale)
            in_sigmas = abs(old - new) / part if part else None
            yield Difference(where, old, new, is_prose, abs(old - new) / largest, in_sigmas)
    elif old != new:
        yield Difference(where, old, new, is_prose)


def is_number(value: Tree) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def known_sigma(siblings: dict[str, Tree], key: str) -> Sigma:
    """Standard deviation of an entry, from its neighbours in the document; 0 if none tells it.

    Of a group of values (intrinsics, a pose) a table, by the name of the value.
    """
    stem, _, unit = key.rpartition("_")
    for name in (f"sigma_{key}", f"{key}_sigma", f"{stem}_sigma_{unit}", f"sigma_{stem}_{unit}"):
        if is_number(siblings.get(name)):
            return abs(float(siblings[name]))
    if key in ("x", "y", "z") and isinstance(siblings.get("sigma_mm"), dict):
        return float(siblings["sigma_mm"]["rms"][0])
    covariance = siblings.get("covariance")
    if isinstance(covariance, dict) and key in ("intrinsics", "tool_from_sensor"):
        matrix = covariance.get("matrix")
        matrix = matrix.get("sample") if isinstance(matrix, dict) else matrix
        sigmas = np.sqrt(np.abs(np.diag(np.array(matrix, dtype=float)))).tolist()
        if key == "intrinsics":
            return dict(zip(covariance["parameter_names"], sigmas, strict=False))
        return {"rotation_rows": max(sigmas[:3]), "translation_tool_mm": max(sigmas[3:])}
    return 0.0
