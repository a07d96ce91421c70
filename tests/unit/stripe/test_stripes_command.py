# SPDX-License-Identifier: Apache-2.0
"""``armscan stripes``: a table and a page of what photographs show, or a refusal and nothing."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli.run import main
from rigs.stripe_image import StripeScene
from rigs.stripe_scenes import line

SCENE = StripeScene((line(12.0),), 320, 240)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k in range(2):
        cv2.imwrite(str(folder / f"lit{k}.png"), SCENE.expose(k).image)
    dark = np.random.default_rng(0).normal(20.0, 1.0, (240, 320))
    cv2.imwrite(str(folder / "dark.png"), dark.astype(np.uint8))
    return folder


def test_table_and_page_of_a_folder(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(photographs), "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    good = [row for row in rows if row["accepted"] == "1"]
    assert {row["image"] for row in good} == {"lit0.png", "lit1.png"}
    assert report["n_points"] == len(good) > 560
    assert report["n_images"] == 2
    assert "dark.png" in report["warnings"][0]
    points = np.array([[float(row["x_px"]), float(row["y_px"])] for row in good])
    assert np.abs(SCENE.errors(points)[0]).max() < 0.3
    assert all(float(row["sigma_px"]) > 0.0 for row in rows)
    flagged = {row["flags"] for row in rows if row["accepted"] == "0"}
    assert flagged <= {"END", "SHORT_SEGMENT", "END+SHORT_SEGMENT", "SHORT_SEGMENT+END"}
    page = out.with_suffix(".html").read_text()
    assert all(name in page for name in ("lit0.png", "lit1.png", "dark.png"))


def test_nothing_is_written_where_an_image_is_cut(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (photographs / "lit1.png").read_bytes()
    (photographs / "lit1.png").write_bytes(whole[: len(whole) // 2])
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(photographs), "-o", str(out)]) == 2
    assert "lit1.png" in capsys.readouterr().err
    assert not out.exists()
    assert not out.with_suffix(".html").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "lines.html"], ".csv"),
        (["--laser-colour", "purple"], "green-red"),
        (["--stripe-method", "magic"], "hessian"),
    ],
)
def test_wrong_options_are_named(
    photographs: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stripes", str(photographs), *words]) == 2
    assert said in capsys.readouterr().err


def test_one_colour_is_taken_for_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three photographs show a red line; in the third a blue line stands out a little more."""
    folder = tmp_path / "colours"
    folder.mkdir()
    for k in range(3):
        image = SCENE.expose_red(k, 1.0).image.copy()
        if k == 2:
            image[40:43, :, 2] = 220
        write_colour(folder / f"{k}.png", image)
    assert main(["stripes", str(folder), "-o", str(tmp_path / "lines.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["laser_colour"] == "red"
    alone = ["stripes", str(folder / "2.png"), "-o", str(tmp_path / "alone.csv"), "--json"]
    assert main(alone) == 0
    assert json.loads(capsys.readouterr().out)["laser_colour"] == "blue"


def test_a_colour_without_a_line_gives_way_to_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Narrow blue things stand out most, none of them a line; the laser is red and weaker."""
    folder = tmp_path / "things"
    folder.mkdir()
    for k in range(2):
        image = SCENE.expose_red(k, 1.0).image.copy()
        image[:, 20:300:40, 2] = image[:, 21:300:40, 2] = 160
        write_colour(folder / f"{k}.png", image)
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(folder), "-o", str(out), "--json"]) == 0
    report, away = written(out, capsys)
    assert report["laser_colour"] == "red"
    assert len(away) > 0.95 * 2 * 320
    assert np.mean(away < 0.5) > 0.99


def test_a_grey_photograph_may_be_stored_with_three_channels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside colour ones, or where a colour is asked for, its line is found as in one channel."""
    folder = tmp_path / "grey"
    folder.mkdir()
    grey = SCENE.expose(0).image
    cv2.imwrite(str(folder / "one.png"), grey)
    cv2.imwrite(str(folder / "three.png"), np.repeat(grey[:, :, None], 3, axis=2))
    write_colour(folder / "red.png", SCENE.expose_red(1, 1.0).image.astype(np.float64))
    out = tmp_path / "lines.csv"
    for words, count in (([], 3), (["--laser-colour", "green-red"], 2)):
        named = [str(folder / name) for name in ("one.png", "three.png", "red.png")[:count]]
        assert main(["stripes", *named, *words, "-o", str(out), "--json", "--force"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert ("laser_colour" in report) == (count == 3), "nothing is told of colours without any"
        with out.open(newline="") as file:
            rows = list(csv.DictReader(file))
        found = [
            [{**row, "image": ""} for row in rows if row["image"] == name]
            for name in ("one.png", "three.png", "red.png")[:count]
        ]
        assert found[0] == found[1]
        assert all(sum(row["accepted"] == "1" for row in one) > 300 for one in found)


def test_nothing_is_said_of_colours_where_grey_images_show_no_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dark = np.random.default_rng(0).normal(20.0, 1.0, (240, 320, 1)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "dark.png"), np.repeat(dark, 3, axis=2))
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(tmp_path / "dark.png"), "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["warnings"] == ["no line was found in dark.png"]


def bars(rng: np.random.Generator) -> np.ndarray:
    """(240, 320) levels of a print of light bars, which a line of light may be told from badly."""
    u = np.arange(320)
    columns = 60.0 + 70.0 * (np.floor(u / 9.0 + 0.3 * rng.random()) % 2)
    return np.tile(columns, (240, 1))


def write_colour(path: Path, levels: np.ndarray) -> None:
    """Write (240, 320, 3) levels of red, green and blue."""
    cv2.imwrite(str(path), np.clip(levels, 0, 255).astype(np.uint8)[:, :, ::-1])


def written(out: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict, np.ndarray]:
    """What is told, and the accepted points' distances from the line, px."""
    report = json.loads(capsys.readouterr().out)
    with out.open(newline="") as file:
        good = [row for row in csv.DictReader(file) if row["accepted"] == "1"]
    points = np.array([[float(row["x_px"]), float(row["y_px"])] for row in good])
    return report, np.abs(SCENE.errors(points.reshape(-1, 2))[0])


def test_light_that_all_colours_have_in_common_is_taken_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A red line over a grey print: red minus green hides the print, red alone does not."""
    folder, rng = tmp_path / "lit", np.random.default_rng(3)
    folder.mkdir()
    for k in range(3):
        red = SCENE.expose_red(k, 1.0).image.astype(np.float64)
        image = 0.6 * red + bars(rng)[..., None] + rng.normal(0.0, 1.0, red.shape)
        write_colour(folder / f"{k}.png", image)
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(folder), "-o", str(out), "--json"]) == 0
    report, away = written(out, capsys)
    assert report["laser_colour"] in {"red-green", "red-blue", "red-excess"}
    assert len(away) > 0.85 * 3 * 320
    assert np.mean(away < 0.5) > 0.99
    alone = ["stripes", str(folder), "--laser-colour", "red", "-o", str(out), "--json", "--force"]
    assert main(alone) == 0
    assert len(written(out, capsys)[1]) < 0.7 * 3 * 320


def test_edges_of_metal_where_no_laser_is_do_not_hide_a_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the images are without laser; bright rails have a lens's fringe of its colour."""
    folder, rng = tmp_path / "rails", np.random.default_rng(5)
    folder.mkdir()
    y, x = np.mgrid[:480, :640]
    rails = [
        sum(np.exp(-0.5 * ((x - u - fringe) / 2.0) ** 2) for u in (30, 60, 90, 550, 580, 610))
        for fringe in (0.2, 0.0, 0.0)
    ]
    metal = 200.0 * np.stack(rails, axis=2)
    stripe = np.exp(-0.5 * ((y - 240.0 - 0.03 * x) / 1.5) ** 2) * (np.abs(x - 320.0) < 200.0)
    for k, peak in enumerate((0.0, 180.0, 0.0, 60.0)):
        image = metal + peak * stripe[..., None] * np.array([1.0, 0.1, 0.1]) + 30.0
        write_colour(folder / f"{k}.png", image + rng.normal(0.0, 1.5, image.shape))
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(folder), "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    with out.open(newline="") as file:
        good = [row for row in csv.DictReader(file) if row["accepted"] == "1"]
    assert report["laser_colour"] in {"red-green", "red-blue", "red-excess"}
    assert {row["image"] for row in good} == {"1.png", "3.png"}
    away = [float(row["y_px"]) - 240.0 - 0.03 * float(row["x_px"]) for row in good]
    assert len(away) > 0.9 * 2 * 400
    assert np.mean(np.abs(away) < 0.5) > 0.99


def test_views_without_laser_are_taken_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the same names, in any order; one for each image."""
    rng = np.random.default_rng(4)
    on, off = tmp_path / "on", tmp_path / "off"
    on.mkdir()
    off.mkdir()
    for k in range(2):
        print_, line_ = bars(rng), SCENE.expose(k).image.astype(np.float64)
        for folder, levels in ((on, 0.5 * line_ + print_), (off, print_)):
            noisy = levels + rng.normal(0.0, 1.0, levels.shape)
            cv2.imwrite(str(folder / f"{k}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
    out = tmp_path / "lines.csv"
    words = ["stripes", str(on), "-o", str(out), "--json", "--force"]
    dark = [text for k in (1, 0) for text in ("--background", str(off / f"{k}.png"))]
    assert main([*words, *dark]) == 0
    _, away = written(out, capsys)
    assert len(away) > 0.9 * 2 * 320
    assert np.mean(away < 0.5) > 0.99
    assert main(words) == 0
    assert len(written(out, capsys)[1]) < 0.7 * 2 * 320
    three = [*dark, "--background", str(on / "0.png")]
    assert main([*words, *three]) == 2
    assert "2 images with laser (0.png, 1.png) but 3 without" in capsys.readouterr().err
    assert main(["stripes", str(off), "-o", str(out), "--force", "--background", str(on)]) == 2
    assert "swap the images" in capsys.readouterr().err
    assert main([*words, "--background", str(on)]) == 2
    assert "its own view without laser" in capsys.readouterr().err
    colour = tmp_path / "colour.png"
    cv2.imwrite(str(colour), np.zeros((*levels.shape, 3), np.uint8))
    assert main([*words, "--background", str(colour)]) == 2
    assert "as the camera took them" in capsys.readouterr().err
    (off / "0.png").rename(off / "2.png")
    assert main([*words, "--background", str(off)]) == 2
    assert "of its own name" in capsys.readouterr().err


def test_one_view_without_laser_is_that_of_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, folder = np.random.default_rng(5), tmp_path / "on"
    folder.mkdir()
    print_ = bars(rng)
    for name, line_ in (("on/0", 0.5), ("on/1", 0.5), ("off", 0.0)):
        levels = line_ * SCENE.expose(0).image + print_ + rng.normal(0.0, 1.0, print_.shape)
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.clip(levels, 0, 255).astype(np.uint8))
    out = tmp_path / "lines.csv"
    dark = ["--background", str(tmp_path / "off.png")]
    assert main(["stripes", str(folder), *dark, "-o", str(out), "--json"]) == 0
    assert len(written(out, capsys)[1]) > 0.9 * 2 * 320


def test_print_of_the_lasers_colour_takes_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Red pen on white paper shows in red minus blue only; the laser shows whole in red."""
    folder, rng = tmp_path / "pen", np.random.default_rng(6)
    folder.mkdir()
    for k in range(2):
        image = SCENE.expose_red(k, 1.0).image.astype(np.float64) + 120.0
        for v in range(8, 240, 16):
            if abs(v - 120) > 40:
                image[v : v + 3, :, 1:] -= 90.0
        image += rng.normal(0.0, 1.0, image.shape)
        write_colour(folder / f"{k}.png", image)
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(folder), "-o", str(out), "--json"]) == 0
    report, away = written(out, capsys)
    assert report["laser_colour"] == "red"
    assert np.mean(away < 0.5) > 0.99
    other = ["stripes", str(folder), "--laser-colour", "red-blue", "-o", str(out), "--force"]
    assert main([*other, "--json"]) == 0
    assert np.mean(written(out, capsys)[1] < 0.5) < 0.5


def write_webcam(folder: Path, white_rows: tuple[int, ...] = ()) -> None:
    """A webcam's colours, coarser than its light and three pixels below it, beside a white core."""
    folder.mkdir()
    for k in range(3):
        image = np.asarray(SCENE.expose_red(k, 2.0).image, np.uint8).copy()
        for row in white_rows:
            image[row : row + 4] = 200
        light = cv2.cvtColor(image, cv2.COLOR_RGB2YCrCb)
        colours = cv2.GaussianBlur(np.roll(light[..., 1:], 3, axis=0), (0, 0), 2.0)
        light[..., 1:] = colours
        write_colour(folder / f"{k}.png", cv2.cvtColor(light, cv2.COLOR_YCrCb2RGB))


def test_colour_stays_where_light_shows_other_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """White strips in the room's light are no laser, wherever the camera's colours lie."""
    folder, out = tmp_path / "strips", tmp_path / "lines.csv"
    write_webcam(folder, white_rows=(20, 220))
    assert main(["stripes", str(folder), "-o", str(out), "--json"]) == 0
    assert written(out, capsys)[0]["laser_colour"] != "grey"


def test_light_is_taken_where_colours_lie_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "webcam"
    write_webcam(folder)
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(folder), "-o", str(out), "--json"]) == 0
    report, away = written(out, capsys)
    assert report["laser_colour"] == "grey"
    assert len(away) > 0.9 * 3 * 320
    red = ["stripes", str(folder), "--laser-colour", "red", "-o", str(out), "--json", "--force"]
    assert main(red) == 0
    assert np.median(written(out, capsys)[1]) > 1.5 > 2.0 * np.median(away)
