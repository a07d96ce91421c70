# SPDX-License-Identifier: Apache-2.0
"""Rendered the photographs of this folder, once: a third of the size, as JPEG."""

from __future__ import annotations

from pathlib import Path

import cv2

from armscan.pipeline.simulate import TwinName

HERE = Path(__file__).parent
SHRINK = 3


def main() -> None:
    chosen = (
        ("board", "thesis-single", "camera", 3),
        ("stripe", "thesis-single", "laser", 0),
        ("rings", "thesis-multi", "markers", 0),
    )
    for name, head, scene, index in chosen:
        scan = TwinName(head, "thesis", 5).build().scan(scene)
        image = scan.exposure(index).image
        height, width = (size // SHRINK for size in image.shape[:2])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(HERE / f"{name}.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 88])
        print(name, scan.rows[index].lasers, small.shape)


if __name__ == "__main__":
    main()
