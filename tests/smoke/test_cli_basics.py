# SPDX-License-Identifier: Apache-2.0
"""The command line's frame: help, version, exit codes, one sentence for each failure."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli import main
from armscan.cli.app import command
from armscan.jobs import info

HELP_SECONDS = 1.2
"""Of a processor, whatever else runs on the machine."""


def command_paths() -> list[tuple[str, ...]]:
    """Every command and group of the tree."""
    found: list[tuple[str, ...]] = []

    def walk(node: object, path: tuple[str, ...]) -> None:
        found.append(path)
        for name, child in getattr(node, "commands", {}).items():
            walk(child, (*path, name))

    walk(command(), ())
    return found


@pytest.mark.parametrize("path", command_paths(), ids=" ".join)
@pytest.mark.parametrize("word", ["-h", "--help"])
def test_help_of_every_command_has_an_example(
    path: tuple[str, ...], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*path, word]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "\n    armscan " in out or "\n  armscan " in out


def test_help_lists_the_commands_as_the_chain(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-h"]) == 0
    listed = capsys.readouterr().out.split("\nCommands:\n")[1].split("\n\n")[0]
    names = [line.split()[0] for line in listed.splitlines() if line[2:3].strip()]
    chain = ["demo", "simulate", "probe", "calibrate", "reconstruct", "fuse", "stripes", "markers"]
    looks = ["clean", "inspect", "verify", "mesh", "record", "console", "convert", "recover"]
    assert names == [*chain, "register", *looks, "info", "devices", "doctor"]


def test_devices_lists_what_is_there_and_the_drivers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--kind", "arm", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {one["kind"] for one in told["devices"]} == {"arm"}
    drivers = {one["name"]: one for one in told["drivers"]}
    assert "webcam" not in drivers and drivers["tcp"]["problem"] == ""
    assert main(["devices"]) == 0
    assert "twin:thesis-single" in capsys.readouterr().out
    assert main(["devices", "--kind", "moon"]) == 2


@pytest.mark.parametrize("path", [(), ("calibrate",), ("inspect",)], ids=" ".join)
def test_a_group_without_a_command_prints_its_help(
    path: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """As lines, not as one sentence; nothing was done, so the exit code is not 0."""
    assert main([*path, "-h"]) == 0
    asked = capsys.readouterr().out
    assert main(list(path)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == asked


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("armscan 0.")


def test_help_is_quick() -> None:
    """Heavy libraries are imported inside the commands only."""
    before = os.times()
    code = (
        "import sys\nfrom armscan.cli import main\nmain(['-h'])\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'numba', 'matplotlib'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines()[-1] == "[]"
    after = os.times()
    assert after.children_user - before.children_user < HELP_SECONDS


@pytest.mark.parametrize("words", [["-h"], ["calibrate", "-h"], ["inspect", "-h"]])
def test_no_command_is_told_in_half_a_sentence(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(words) == 0
    commands = capsys.readouterr().out.partition("Commands:\n")[2].partition("\n\n")[0]
    assert len(commands.splitlines()) > 4
    assert "..." not in commands


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nonsense"], "No such command 'nonsense'"),
        (["info"], "Missing argument"),
        (["info", "--nonsense", "x"], "No such option"),
        (
            ["calibrate", "laser", "--camera=c", "--target=t", "--on", "a.png", "b.png"],
            "Put quotes around patterns",
        ),
        (["info", "absent.png"], "absent.png: there is no such file"),
    ],
)
def test_a_wrong_line_gets_one_sentence(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("failure", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted; no file is left half-written"),
        (OSError(errno.ENOSPC, "No space left on device", "x.json"), 2, "x.json: No space left"),
        (PermissionError(errno.EACCES, "Permission denied", "x.json"), 2, "Permission denied"),
        (MemoryError(), 2, "not enough memory"),
        (ZeroDivisionError("division by zero"), 70, "ARMSCAN_DEBUG=1"),
    ],
)
def test_failures_become_codes(
    failure: BaseException,
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("ARMSCAN_DEBUG", raising=False)
    monkeypatch.setattr(info, "describe_files", _raiser(failure))
    assert main(["info", "x"]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert "Traceback" not in err


LONG_WORK = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from armscan.cli import app, main
from armscan.pipeline import progress
progress.count_cores = lambda: 2
def work(item):
    if item == 0:
        print("begun", file=sys.stderr, flush=True)
    time.sleep(60.0)
app.command = lambda: lambda **_: list(progress.in_order(work, range(6), 2))
sys.exit(main())
"""
WITHIN_EXEC = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from armscan.cli import app, main
wait = "import time; print('begun', file=sys.stderr, flush=True); time.sleep(60.0)"
app.command = lambda: lambda **_: exec(wait)
sys.exit(main())
"""


PERSON_S = 0.05
"""Between two Ctrl-C of a person at the least."""


@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
def test_an_interrupt_ends_a_command_whose_messages_nobody_reads_any_more() -> None:
    """Ctrl-C in ``armscan ... 2>&1 | tee log`` ends tee as well."""
    with subprocess.Popen([sys.executable, "-c", LONG_WORK], stderr=subprocess.PIPE) as run:
        assert run.stderr is not None
        while run.stderr.readline() != b"begun\n":
            assert run.poll() is None, "it ended by itself"
        run.stderr.close()
        run.send_signal(signal.SIGINT)
        try:
            assert run.wait(timeout=20.0) == 130
        finally:
            run.kill()


@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
@pytest.mark.parametrize("program", [LONG_WORK, WITHIN_EXEC], ids=["threads", "exec"])
@pytest.mark.parametrize(
    ("numbers", "code", "word"),
    [
        ([signal.SIGINT], 130, "interrupted"),
        ([signal.SIGINT] * 3, 130, "interrupted"),
        ([signal.SIGTERM], 143, "ended"),
    ],
    ids=["one", "three", "term"],
)
def test_what_ends_a_command_does_not_wait_for_what_it_had_begun(
    program: str, numbers: list[signal.Signals], code: int, word: str
) -> None:
    words = [sys.executable, "-c", program]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None
        while run.stderr.readline() != "begun\n":
            assert run.poll() is None, "it ended by itself"
        for number in numbers:
            run.send_signal(number)
            time.sleep(PERSON_S)
        try:
            err = run.communicate(timeout=20.0)[1]
        finally:
            run.kill()
    assert run.returncode == code
    assert err.removeprefix("begun\n") == f"{word}; no file is left half-written\n"


def test_a_bug_shows_its_traceback_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARMSCAN_DEBUG", "1")
    monkeypatch.setattr(info, "describe_files", _raiser(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        main(["info", "x"])


def _raiser(failure: BaseException) -> object:
    def fail(*_: object) -> None:
        raise failure

    return fail


def test_info_of_images_and_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = np.full((4, 6), 17, np.uint8)
    image[0, 0] = 255
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert main(["info", str(tmp_path), str(tmp_path / "a.png"), "--json"]) == 0
    folder, file = json.loads(capsys.readouterr().out)["items"]
    assert folder["files_png"] == 1
    assert (file["width_px"], file["height_px"], file["bits_used"]) == (6, 4, 8)
    assert file["saturated_fraction"] == pytest.approx(1 / 24, abs=1e-6)
    assert main(["info", str(tmp_path / "a.png")]) == 0
    assert "image, 6 x 4 px, grey, 8 bits" in capsys.readouterr().out


def test_info_of_a_mesh_tells_its_faces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kinds = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    header = f"ply\nformat ascii 1.0\nelement vertex 3\n{kinds}{faces}end_header\n"
    path = tmp_path / "part.ply"
    path.write_text(f"{header}0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    assert main(["info", str(path)]) == 0
    assert "mesh, 3 vertices and 1 faces" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("heading", "what"),
    [
        ("x,y,z", "point cloud, 2 points"),
        ("nx,ny,nz,Z [mm],Y [mm],X [mm]", "point cloud, 2 points"),
        ("x;y;z;r;g;b", "point cloud, 2 points"),
        ("x_mm,y_mm,z_mm", "probed points"),
        ("name,age", ""),
    ],
)
def test_info_of_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], heading: str, what: str
) -> None:
    """A cloud of another program, which every other command reads, was no file of ours."""
    sep, names = (";" if ";" in heading else ","), heading.replace(";", ",").split(",")
    rows = [sep.join(str(float(k + n)) for n in range(len(names))) for k in range(2)]
    path = tmp_path / "c.csv"
    path.write_text("\n".join([heading, *rows, ""]))
    assert main(["info", str(path)]) == (0 if what else 2)
    said = capsys.readouterr()
    assert what in said.out if what else "which of 2 columns are x, y and z" in said.err


def test_info_of_documents(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    golden = Path(__file__).parents[1] / "golden"
    assert main(["info", str(golden / "camera_v1.json"), str(golden / "sensor_v1.json")]) == 0
    out = capsys.readouterr().out
    assert "camera calibration, 960 x 1280 px" in out
    assert "sensor calibration, 2 light sheets" in out
    (tmp_path / "x.txt").write_text("text")
    assert main(["info", str(tmp_path / "x.txt")]) == 2
    assert "does not know this kind of file" in capsys.readouterr().err


def test_info_tells_of_lasers_without_a_sheet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = json.loads((Path(__file__).parents[1] / "golden/sensor_v1.json").read_text())
    assert main(["info", str(Path(__file__).parents[1] / "golden/sensor_v1.json")]) == 0
    assert "without" not in capsys.readouterr().out
    (tmp_path / "sensor.json").write_text(json.dumps({**tree, "lasers_without_sheet": ["far"]}))
    assert main(["info", str(tmp_path / "sensor.json")]) == 0
    assert "lasers without sheet: far" in capsys.readouterr().out


def test_doctor_is_content(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["is_ready"] is True
    assert report["found"]["numpy"] == np.__version__
    extras = ("pye57", "laspy", "scikit-image", "fast-simplification", "weasyprint", "viser")
    assert set(extras) | {"cadquery-ocp-novtk"} <= set(report["found"])


def test_completion_is_offered() -> None:
    result = subprocess.run(
        [sys.executable, "-c", "import sys; from armscan.cli import main; sys.exit(main())"],
        env={"_ARMSCAN_COMPLETE": "complete_bash", "COMP_WORDS": "armscan do", "COMP_CWORD": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "doctor" in result.stdout


def test_a_terminal_without_our_signs_is_served() -> None:
    golden = Path(__file__).parents[1] / "golden" / "camera_v1.json"
    words = f"['info', {str(golden)!r}]"
    result = subprocess.run(
        [
            sys.executable,
            "-c",
            f"import sys; from armscan.cli import main; sys.exit(main({words}))",
        ],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "fx px: 477." in result.stdout


def test_the_package_runs_as_a_module() -> None:
    """Where the script is not on the path: the same command line and exit codes."""
    for words, code in ((["--version"], 0), (["nosuch"], 2)):
        result = subprocess.run(
            [sys.executable, "-m", "armscan", *words], capture_output=True, text=True, check=False
        )
        assert result.returncode == code
        assert "armscan 0." in result.stdout if code == 0 else "nosuch" in result.stderr
