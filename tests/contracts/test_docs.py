# SPDX-License-Identifier: Apache-2.0
"""The pages say what the code does: examples run, links lead somewhere, named code exists."""

from __future__ import annotations

import doctest
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGE_IDS = [str(page.relative_to(ROOT)) for page in PAGES]


def test_the_examples_of_the_conventions_page_run() -> None:
    result = doctest.testfile(str(ROOT / "docs" / "conventions.md"), module_relative=False)
    assert result.attempted > 10
    assert result.failed == 0


@pytest.mark.parametrize("page", PAGES, ids=PAGE_IDS)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    slugs: list[str] = []
    for heading in re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE):
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        slugs.append(slug)
    return {
        slug if (before := slugs[:k].count(slug)) == 0 else f"{slug}-{before}"
        for k, slug in enumerate(slugs)
    }


@pytest.mark.parametrize("page", PAGES, ids=PAGE_IDS)
def test_links_to_headings_lead_to_one(page: Path) -> None:
    lost = []
    for target, anchor in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", page.read_text()):
        other = page.parent / target if target else page
        if "://" not in target and other.suffix == ".md" and anchor not in anchors(other):
            lost.append(f"{target}#{anchor}")
    assert lost == []


def test_a_heading_that_does_not_exist_is_noticed() -> None:
    found = anchors(ROOT / "docs" / "reference" / "commands.md")
    assert "for-all-commands" in found
    assert "for-no-command" not in found


def named_objects(page: Path) -> list[str]:
    return sorted(set(re.findall(r"`(armscan(?:\.\w+)+)`", page.read_text())))


@pytest.mark.parametrize("page", PAGES, ids=PAGE_IDS)
def test_code_named_on_a_page_exists(page: Path) -> None:
    for name in named_objects(page):
        assert resolves(name), f"{page.name} names {name}"


def resolves(name: str) -> bool:
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[cut:]:
            if not hasattr(found, attribute):
                return False
            found = getattr(found, attribute)
        return True
    return False


def test_a_name_that_does_not_exist_is_noticed() -> None:
    assert resolves("armscan.models.camera.CameraModel.project")
    assert not resolves("armscan.models.camera.CameraModel.no_such_method")


@pytest.mark.parametrize(("chapter", "last"), [(2, 76), (3, 7), (4, 30)])
def test_every_numbered_equation_is_mapped(chapter: int, last: int) -> None:
    table = (ROOT / "docs" / "reference" / "thesis-equations.md").read_text()
    mapped = {int(n) for n in re.findall(rf"^\| {chapter}\.(\d+)", table, flags=re.MULTILINE)}
    assert set(range(1, last + 1)) <= mapped
