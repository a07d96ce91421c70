# SPDX-License-Identifier: Apache-2.0
"""The commands the net runs: a line each, in groups that do not depend on each other.

A line is ``name | words of the command``; it runs in a folder that holds a copy of ``inputs/``, and
what one line of a group wrote is there for the next ones. ``refused`` lines must end in a sentence.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

T = "--target chessboard:8x6:6"
D = "documents"

GROUPS: dict[str, str] = {
    "camera": f"""
auto | calibrate camera left/*.jpg {T} -o camera.json --json
text | calibrate camera left/*.jpg {T} -o text.json --distortion k1 --no-cache
fixed | calibrate camera left/*.jpg {T} -o fixed.json --distortion k1k2 --fix aspect --fix centre --json
warp | calibrate camera left {T} -o warp.json --board-warp --distortion none --json
leave | calibrate camera left/*.jpg {T} -o leave.json --leave-out view3.jpg --distortion k1k2p1p2k3 --json
auto-leave | calibrate camera left/*.jpg {T} -o autoleave.json --auto-leave-out --distortion none --json
scan | calibrate camera --scan two-cameras {T} -o scan.json --json
again | calibrate camera left/*.jpg {T} -o camera.json --json
force | calibrate camera left/*.jpg {T} -o camera.json --distortion none --force --json
few | calibrate camera left/view0.jpg left/view1.jpg {T} -o few.json --json
one | calibrate camera left/view0.jpg {T} -o one.json
wrong-count | calibrate camera left/*.jpg --target chessboard:9x7:6 -o count.json --no-cache
wrong-kind | calibrate camera left/*.jpg --target circle-grid:9x7:6 -o kind.json --no-cache
no-target | calibrate camera left/*.jpg -o no.json
bad-target | calibrate camera left/*.jpg --target chessboard:8x -o no.json
bad-target-2 | calibrate camera left/*.jpg --target triangles:8x6:6 -o no.json
bad-target-3 | calibrate camera left/*.jpg --target chessboard:8x6:-6 -o no.json
bad-distortion | calibrate camera left/*.jpg {T} --distortion k9 -o no.json
bad-fix | calibrate camera left/*.jpg {T} --fix everything -o no.json
none-found | calibrate camera nowhere/*.jpg {T} -o no.json
empty | calibrate camera bad/empty-folder {T} -o no.json
leave-none | calibrate camera left/*.jpg {T} --leave-out view99.jpg -o no.json
not-image | calibrate camera bad/not-image.jpg left/*.jpg {T} -o no.json --no-cache
cut-image | calibrate camera bad/cut.jpg left/*.jpg {T} -o no.json --no-cache
bits | calibrate camera left/*.jpg {T} --bits-used 12 -o no.json --no-cache
other-size | calibrate camera left/*.jpg bad/small.png {T} -o no.json --no-cache
no-folder | calibrate camera left/*.jpg {T} -o nowhere/no.json --no-cache
wrong-end | calibrate camera left/*.jpg {T} -o no.txt --no-cache
both | calibrate camera left/*.jpg --scan two-cameras {T} -o no.json
neither | calibrate camera {T} -o no.json
unknown-option | calibrate camera left/*.jpg {T} --sharp -o no.json
""",
    "stereo": f"""
plain | calibrate stereo left/*.jpg right/*.jpg {T} -o stereo.json --json
prior | calibrate stereo --scan two-cameras {T} -o prior.json --left {D}/camera.json --right {D}/right.json --json
held | calibrate stereo left right {T} -o held.json --left {D}/camera.json --right {D}/right.json --intrinsics fixed --json
scan | calibrate stereo --scan two-cameras {T} -o scan.json --distortion none --json
leave | calibrate stereo left right {T} -o leave.json --leave-out view3.jpg --auto-leave-out --distortion k1 --json
uneven | calibrate stereo left right/view0.jpg {T} -o no.json
one-side | calibrate stereo left {T} -o no.json
shifted | calibrate stereo bad/shifted-left right {T} -o no.json --no-cache
no-prior | calibrate stereo left right {T} --intrinsics fixed -o no.json
twice-evidence | calibrate stereo left right {T} -o no.json --left {D}/camera.json --right {D}/right.json
wrong-document | calibrate stereo left right {T} --left {D}/sensor.json -o no.json --no-cache
absent | calibrate stereo left right {T} --left absent.json -o no.json --no-cache
""",
    "laser": f"""
single | calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/*.jpg {T} -o sensor.json --json
plane | calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/*.jpg {T} -o plane.json --plane-only --name red
on-only | calibrate laser --camera {D}/camera.json --on on/*.jpg {T} -o ononly.json --sheets 1 --json
hessian | calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/*.jpg {T} -o hessian.json --stripe-method hessian --margin-mm 3 --json
cross | calibrate laser --camera {D}/camera.json --on cross/*.jpg --off off/*.jpg {T} -o cross.json --name A --name B --json
multi | calibrate laser --camera {D}/stereo.json --scan two-cameras {T} -o multi.json --json
ros | calibrate laser --camera foreign/camera_info.yaml --on on/*.jpg --off off/*.jpg {T} -o ros.json --json
leave | calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/*.jpg {T} -o leave.json --leave-out place0.jpg --json
one-board | calibrate laser --camera {D}/camera.json --on on/place0.jpg {T} -o no.json
no-stripe | calibrate laser --camera {D}/camera.json --on off/*.jpg {T} -o no.json --no-cache
uneven | calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/place0.jpg --off off/place1.jpg {T} -o no.json
uneven-2 | calibrate laser --camera {D}/camera.json --on on/*.jpg --off bad/two-off {T} -o no.json
wrong-sheets | calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/*.jpg {T} --sheets 3 -o no.json --no-cache
no-on | calibrate laser --camera {D}/camera.json {T} -o no.json
bad-method | calibrate laser --camera {D}/camera.json --on on/*.jpg {T} --stripe-method magic -o no.json
bad-colour | calibrate laser --camera {D}/camera.json --on on/*.jpg {T} --laser-colour mauve -o no.json
bad-margin | calibrate laser --camera {D}/camera.json --on on/*.jpg {T} --margin-mm nan -o no.json
absent-camera | calibrate laser --camera absent.json --on on/*.jpg {T} -o no.json
cloud-camera | calibrate laser --camera {D}/ball.ply --on on/*.jpg {T} -o no.json
wrong-size-camera | calibrate laser --camera bad/camera-size.json --on on/*.jpg {T} -o no.json
nan-camera | calibrate laser --camera bad/camera-nan.json --on on/*.jpg {T} -o no.json
cut-camera | calibrate laser --camera bad/camera-cut.json --on on/*.jpg {T} -o no.json
newer-camera | calibrate laser --camera bad/camera-newer.json --on on/*.jpg {T} -o no.json
key-camera | calibrate laser --camera bad/camera-key.json --on on/*.jpg {T} -o no.json
twice-camera | calibrate laser --camera bad/camera-twice.json --on on/*.jpg {T} -o no.json
""",
    "hand-eye": f"""
plane | calibrate hand-eye plate-scan --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o scanner.json --json
plate | calibrate hand-eye plate-scan --sensor {D}/sensor.json --plate tables/plate.csv -o plate.json --arm-position-mm 0.01 --plate-flatness-mm 0.005 --json
solve | calibrate hand-eye plate-scan --sensor {D}/sensor.json --plate tables/plate.csv --solve-plate -o solve.json
ball | calibrate hand-eye ball-rest --sensor {D}/sensor.json --sphere-diameter 30 -o ball.json --json
profiles | calibrate hand-eye --profiles profiles/p*.csv --poses profiles/poses.txt --sphere-diameter 80 -o profiles.json --json
several | calibrate hand-eye plate-scan bad/half-scan --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o several.json --json
few | calibrate hand-eye bad/few-scan --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
no-reference | calibrate hand-eye plate-scan --sensor {D}/sensor.json -o no.json
two-references | calibrate hand-eye plate-scan --sensor {D}/sensor.json --plane 0,0,1,0 --sphere-diameter 30 -o no.json
no-sensor | calibrate hand-eye plate-scan --plane 0,0,1,0 -o no.json
zero-normal | calibrate hand-eye plate-scan --sensor {D}/sensor.json --plane 0,0,0,1 -o no.json
two-numbers | calibrate hand-eye plate-scan --sensor {D}/sensor.json --plane 1,2 -o no.json
far-plane | calibrate hand-eye bad/half-scan --sensor {D}/sensor.json --plane 1,0,0.2,-400 -o no.json
wrong-euler | calibrate hand-eye --profiles profiles/p*.csv --poses profiles/poses.txt --euler zyx --sphere-diameter 80 -o no.json
other-euler | calibrate hand-eye --profiles profiles/p*.csv --poses profiles/poses.txt --euler intrinsic-zxz --sphere-diameter 80 -o no.json
uneven-poses | calibrate hand-eye --profiles profiles/p0*.csv --poses profiles/poses.txt --sphere-diameter 80 -o no.json
wrong-sphere | calibrate hand-eye bad/half-ball --sensor {D}/sensor.json --sphere-diameter 90 -o no.json
zero-sphere | calibrate hand-eye ball-rest --sensor {D}/sensor.json --sphere-diameter 0 -o no.json
camera-only | calibrate hand-eye plate-scan --sensor {D}/camera.json --plane 0,0,1,0 -o no.json
no-scan | calibrate hand-eye nowhere --sensor {D}/sensor.json --plane 0,0,1,0 -o no.json
no-arm | calibrate hand-eye bad/no-arm --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
nan-arm | calibrate hand-eye bad/nan-arm --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o nanarm.json --json
text-arm | calibrate hand-eye bad/text-arm --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
twice-arm | calibrate hand-eye bad/twice-arm --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
swapped-arm | calibrate hand-eye bad/swapped-arm --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
no-rotation | calibrate hand-eye bad/no-rotation --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
inches | calibrate hand-eye bad/inches --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o inches.json
unknown-session | calibrate hand-eye bad/unknown-session --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
missing-image | calibrate hand-eye bad/missing-image --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
two-heights | calibrate hand-eye bad/moved-view --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o no.json
""",
    "reconstruct": f"""
image | reconstruct plain/single.jpg --background plain/dark.jpg --sensor {D}/sensor.json --sheet A -o image.ply --json
text | reconstruct plain/single.jpg --sensor {D}/sensor.json -o text.xyz
margin | reconstruct plain/single.jpg --sensor {D}/sensor.json --depth-margin 0.5 --stripe-method centroid -o margin.ply --json
cross | reconstruct plain/cross.jpg --background plain/dark.jpg --sensor {D}/cross.json -o cross.ply --json
multi | reconstruct plain/multi0.jpg --right plain/multi1.jpg --sensor {D}/multi.json -o multi.ply --json
ball-scan | reconstruct ball-scan --scanner {D}/scanner.json -o ball.ply --json
volume | reconstruct ball-scan --scanner {D}/scanner.json --volume 300,320,-50,-30,80,110 -o volume.ply --json
plate-scan | reconstruct plate-scan --scanner {D}/scanner.json -o plate.ply --json
in-sensor | reconstruct plate-scan --sensor {D}/sensor.json -o insensor.ply --json
threshold | reconstruct plain/single.jpg --sensor {D}/sensor.json --stripe-method threshold -o threshold.ply --json
template | reconstruct plain/single.jpg --sensor {D}/sensor.json --stripe-method template -o template.ply --json
hessian | reconstruct plain/single.jpg --sensor {D}/sensor.json --stripe-method hessian -o hessian.ply --json
again | reconstruct plain/single.jpg --sensor {D}/sensor.json -o image.ply
dark | reconstruct plain/dark.jpg --sensor {D}/sensor.json -o no.ply
wrong-sheet | reconstruct plain/single.jpg --sensor {D}/sensor.json --sheet Z -o no.ply
camera-only | reconstruct plain/single.jpg --sensor {D}/camera.json -o no.ply
no-right | reconstruct plain/multi0.jpg --sensor {D}/multi.json -o noright.ply
right-of-one | reconstruct plain/single.jpg --right plain/dark.jpg --sensor {D}/sensor.json -o no.ply
bad-volume | reconstruct ball-scan --scanner {D}/scanner.json --volume 1,2,3 -o no.ply
turned-volume | reconstruct ball-scan --scanner {D}/scanner.json --volume 320,300,-50,-30,80,110 -o no.ply
far-volume | reconstruct ball-scan --scanner {D}/scanner.json --volume 3000,3200,-50,-30,80,110 -o no.ply
bad-margin | reconstruct plain/single.jpg --sensor {D}/sensor.json --depth-margin -1 -o no.ply
nan-margin | reconstruct plain/single.jpg --sensor {D}/sensor.json --depth-margin nan -o no.ply
wrong-end | reconstruct plain/single.jpg --sensor {D}/sensor.json -o no.stl
bits-of-scan | reconstruct ball-scan --scanner {D}/scanner.json --bits-used 12 -o no.ply
no-images | reconstruct nowhere/*.jpg --sensor {D}/sensor.json -o no.ply
small | reconstruct bad/small.png --sensor {D}/sensor.json -o no.ply
profiles-scanner | reconstruct ball-scan --scanner {D}/profiles.json -o no.ply
few-arm | reconstruct bad/late-arm --scanner {D}/scanner.json -o late.ply --json
other-laser | reconstruct bad/other-laser --scanner {D}/scanner.json -o no.ply
no-time | reconstruct bad/no-time --scanner {D}/scanner.json -o no.ply
outside-path | reconstruct bad/outside-path --scanner {D}/scanner.json -o no.ply
bad-scanner | reconstruct ball-scan --scanner bad/scanner-cut.json -o no.ply
""",
    "verify": f"""
ball | verify ball-scan --scanner {D}/scanner.json --ball 30 -o ball.html --json
ball-mpe | verify ball-scan --scanner {D}/scanner.json --ball 30 --mpe 0.001 --uncertainty 0.0005 --json
wrong-ball | verify ball-scan --scanner {D}/scanner.json --ball 29.5 --mpe 0.1 --json
plate | verify plate-scan --scanner {D}/scanner.json --plate tables/plate.csv --json
cloud | verify {D}/ball.ply --ball 30 --mpe 0.3
no-standard | verify ball-scan --scanner {D}/scanner.json
two-standards | verify ball-scan --scanner {D}/scanner.json --ball 30 --plate tables/plate.csv
no-scanner | verify ball-scan --ball 30
no-limit | verify {D}/ball.ply --ball 30
zero | verify ball-scan --scanner {D}/scanner.json --ball 0
sensor | verify ball-scan --scanner {D}/sensor.json --ball 30
no-ball | verify ball-scan --scanner {D}/scanner.json --ball 300
""",
    "inspect": f"""
plane | inspect plane tables/plane.xyz -o plane.html --json
nominal | inspect plane tables/plane.xyz --plane 0.02,-0.01,-1,5 --json
plate | inspect plane {D}/plate.ply --plate tables/plate.csv -o plate.html --json
ply | inspect plane {D}/plate.ply
region | inspect plane tables/plane.xyz --region -10,10,-10,10,0,10 --feature-mm 0.5 --json
narrow | inspect plane tables/plane.xyz --feature-mm 0.05
sphere | inspect sphere tables/ball.xyz --diameter 34.96 -o ball.html --json
scanned | inspect sphere {D}/ball.ply --diameter 30 --json
step | inspect step tables/step.csv --height 20 -o step.html --json
step-normal | inspect step tables/step.csv --height 20 --normal 0,0,1 --margin 2
wrong-step | inspect step tables/step.csv --height 5 --json
no-step | inspect step tables/plane.xyz --height 20
bad-plane | inspect plane tables/plane.xyz --plane 1,2
zero-plane | inspect plane tables/plane.xyz --plane 0,0,0,1
two-planes | inspect plane tables/plane.xyz --plane 0,0,1,0 --plate tables/plate.csv
bad-region | inspect plane tables/plane.xyz --region 1,2,3
empty-region | inspect plane tables/plane.xyz --region 900,910,900,910,900,910
absent | inspect plane absent.ply
empty | inspect plane bad/empty.xyz
nan | inspect plane bad/nan.xyz
commas | inspect plane bad/commas.xyz
cut | inspect plane bad/cut.ply
two-points | inspect plane bad/two.xyz
line | inspect plane bad/line.xyz
image | inspect sphere left/view0.jpg --diameter 30
document | inspect sphere {D}/camera.json --diameter 30
negative | inspect sphere tables/ball.xyz --diameter -3
nan-diameter | inspect sphere tables/ball.xyz --diameter nan
wrong-diameter | inspect sphere tables/ball.xyz --diameter 80 --json
zero-normal | inspect step tables/step.csv --height 20 --normal 0,0,0
""",
    "markers": f"""
image | markers plain/rings0.jpg -o image.html --json
both | markers plain/rings0.jpg plain/rings1.jpg
stereo | markers plain/rings0.jpg plain/rings1.jpg --stereo {D}/stereo.json --diameter 6 -o inspace.csv --json
depth | markers plain/rings0.jpg plain/rings1.jpg --stereo {D}/stereo.json --diameter 6 --depth 120:200 -o depth.csv --json
nothing | markers left/view0.jpg --json
dark-disc | markers plain/rings0.jpg --disc dark --json
one-image | markers plain/rings0.jpg --stereo {D}/stereo.json --diameter 6 -o no.csv
no-diameter | markers plain/rings0.jpg plain/rings1.jpg --stereo {D}/stereo.json -o nodiameter.csv
camera | markers plain/rings0.jpg plain/rings1.jpg --stereo {D}/camera.json --diameter 6 -o no.csv
swapped | markers plain/rings1.jpg plain/rings0.jpg --stereo {D}/stereo.json --diameter 6 -o no.csv
bad-depth | markers plain/rings0.jpg plain/rings1.jpg --stereo {D}/stereo.json --depth 200:120 -o no.csv
bad-disc | markers plain/rings0.jpg --disc grey
turned-limits | markers plain/rings0.jpg --min-perimeter 500 --max-perimeter 100
absent | markers absent.jpg
""",
    "register": """
views | register tables/view1.csv tables/view2.csv tables/view3.csv -o joined --json
moved | register tables/before.csv --moved tables/after.csv -o moved --json
by-id | register tables/before.csv --moved tables/after.csv --by-id -o byid
cloud | register tables/before.csv --moved tables/after.csv --cloud tables/plane.xyz --sigma-mm 0.05 -o cloud --json
again | register tables/view1.csv tables/view2.csv -o joined
apart | register tables/view1.csv tables/view3.csv -o apart
one | register tables/view1.csv -o one
many-common | register tables/view1.csv tables/view2.csv --least-common 9 -o many
few-common | register tables/view1.csv tables/view2.csv --least-common 2 -o few
not-a-list | register tables/view1.csv left/view0.jpg -o not
empty-list | register tables/view1.csv bad/empty.csv -o empty
nan-list | register tables/view1.csv bad/nan.csv -o nan
swapped-list | register tables/view1.csv bad/no-column.csv -o swapped
by-id-views | register tables/view1.csv tables/view2.csv --by-id -o byidviews
twice-id | register bad/twice-id.csv --moved tables/after.csv --by-id -o twice
""",
    "probe": """
centres | probe tables/centres.csv -o plate.csv --side +z --json
surface | probe tables/plate.csv -o surface.csv
outlier | probe tables/centres_bad.csv --side +z --json
leave-out | probe tables/centres_bad.csv --side +z --leave-out -o left.csv --json
other-side | probe tables/centres.csv --side -z -o other.csv --json
no-side | probe tables/centres.csv -o no.csv
bad-side | probe tables/centres.csv --side up -o no.csv
square-side | probe tables/centres.csv --side +x -o no.csv
no-feature | probe tables/centres.csv --side +z --feature lid -o no.csv
two | probe bad/two.csv -o no.csv
line | probe bad/line.csv -o no.csv
absent | probe absent.csv -o no.csv
no-columns | probe bad/no-column.csv -o no.csv
nan | probe bad/nan.csv -o no.csv
no-tip | probe plate-scan -o no.csv
""",
    "simulate": """
probing | simulate thesis-single probing -o probing --json
touches | probe probing -o touched.csv --json
still-step | simulate thesis-single still-step -o step --seed 3 --processes 1 --json
again | simulate thesis-single probing -o probing
bad-head | simulate thesis-none probing -o no
bad-scene | simulate thesis-single moon -o no
bad-seed | simulate thesis-single probing -o no --seed -4
bad-preset | simulate thesis-single probing -o no --preset awful
bad-processes | simulate thesis-single probing -o no --processes 0
""",
    "convert": f"""
ros | convert {D}/camera.json camera.yaml --json
ros-sensor | convert {D}/sensor.json sensor.yaml
xyz | convert {D}/ball.ply ball.xyz --json
again | convert {D}/ball.ply ball.xyz
to-png | convert {D}/ball.ply ball.png
back | convert ball.xyz ball2.ply
stereo | convert {D}/stereo.json stereo.yaml
absent | convert absent.json a.yaml
table | convert tables/plate.csv a.yaml
""",
    "info": f"""
documents | info {D}/camera.json {D}/stereo.json {D}/sensor.json {D}/cross.json {D}/multi.json {D}/scanner.json {D}/profiles.json --json
text | info {D}/camera.json {D}/scanner.json {D}/ball.ply plate-scan left
clouds | info {D}/ball.ply {D}/plate.ply --json
xyz | info tables/ball.xyz
others | info {D}/camera.npz {D}/sensor.npz left on/place0.jpg ball-scan two-cameras tables/view1.csv tables/plate.csv --json
foreign | info foreign/camera_info.yaml --json
absent | info absent.json
cut | info bad/camera-cut.json
cut-cloud | info bad/cut.ply
empty | info bad/empty-folder
not-image | info bad/not-image.jpg
newer | info bad/camera-newer.json --json
unknown | info bad/no-column.csv
bad-scans | info bad/nan-arm bad/no-arm bad/swapped-arm bad/missing-image --json
bad-session | info bad/unknown-session
""",
    "doctor": """
text | doctor
json | doctor --json
version | --version
nothing | nothing
bad-demo | demo moon -o d
bad-demo-seed | demo single --seed -1 -o d
camera-help | calibrate camera -h
""",
}


def prepare(workspace: Path) -> None:
    """Make the wrong files that the refusals need out of the right ones."""
    bad = workspace / "bad"
    (bad / "empty-folder").mkdir(parents=True)
    (bad / "not-image.jpg").write_text("this is no image\n")
    photo = (workspace / "left/view0.jpg").read_bytes()
    (bad / "cut.jpg").write_bytes(photo[: len(photo) // 2])
    import cv2

    cv2.imwrite(str(bad / "small.png"), np.full((60, 80), 90, np.uint8))
    (bad / "shifted-left").mkdir()
    left = sorted((workspace / "left").iterdir())
    for k, path in enumerate(left):
        shutil.copy(left[(k + 3) % len(left)], bad / "shifted-left" / path.name)
    (bad / "two-off").mkdir()
    for path in sorted((workspace / "off").iterdir())[:2]:
        shutil.copy(path, bad / "two-off" / f"other{path.name}")
    _bad_documents(workspace, bad)
    _bad_tables(workspace, bad)
    _bad_recordings(workspace, bad)
    (workspace / "foreign").mkdir()
    camera = json.loads((workspace / D / "camera.json").read_text())["camera"]["intrinsics"]
    f = camera
    (workspace / "foreign/camera_info.yaml").write_text(
        "image_width: 480\nimage_height: 360\ncamera_name: net\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{f['fx_px']}, 0, {f['cx_px']}, 0, "
        f"{f['fy_px']}, {f['cy_px']}, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{f['k1']}, {f['k2']}, "
        f"{f['p1']}, {f['p2']}, {f['k3']}]\n"
    )


def _bad_documents(workspace: Path, bad: Path) -> None:
    text = (workspace / D / "camera.json").read_text()
    document = json.loads(text)
    (bad / "camera-cut.json").write_text(text[: len(text) // 2])
    (bad / "camera-nan.json").write_text(
        text.replace(repr(document["camera"]["intrinsics"]["fx_px"]), "NaN")
    )
    (bad / "camera-newer.json").write_text(json.dumps(document | {"schema_version": 99}))
    (bad / "camera-key.json").write_text(json.dumps(document | {"colour": "blue"}))
    (bad / "camera-twice.json").write_text(text.replace("{", '{"schema_version": 1,', 1))
    document["camera"]["intrinsics"]["width_px"] = 640
    (bad / "camera-size.json").write_text(json.dumps(document))
    text = (workspace / D / "scanner.json").read_text()
    (bad / "scanner-cut.json").write_text(text[:-200])


def _bad_tables(workspace: Path, bad: Path) -> None:
    for name, text in {
        "empty.xyz": "",
        "nan.xyz": "1 2 3\n1 nan 3\n2 2 2\n3 3 1\n",
        "commas.xyz": "1,5 2,5 3,5\n2,5 2,5 1,5\n",
        "two.xyz": "1 2 3\n4 5 6\n",
        "line.xyz": "".join(f"{k} {2 * k} {3 * k}\n" for k in range(40)),
        "empty.csv": "x_mm,y_mm,z_mm\n",
        "nan.csv": "x_mm,y_mm,z_mm\n1,2,3\n4,nan,6\n7,8,1\n1,1,1\n5,2,2\n",
        "no-column.csv": "x_mm,z_mm\n1,2\n3,4\n5,6\n7,9\n",
        "two.csv": "x_mm,y_mm,z_mm\n1,2,3\n4,5,6\n",
        "line.csv": "x_mm,y_mm,z_mm\n" + "".join(f"{k},{2 * k},{3 * k}\n" for k in range(9)),
    }.items():
        (bad / name).write_text(text)
    rows = (workspace / "tables/before.csv").read_text().splitlines()
    rows[3] = rows[3].rpartition(",")[0] + ",1"
    (bad / "twice-id.csv").write_text("\n".join(rows) + "\n")
    cloud = (workspace / D / "ball.ply").read_bytes()
    (bad / "cut.ply").write_bytes(cloud[: len(cloud) // 2])


def _bad_recordings(workspace: Path, bad: Path) -> None:
    def arm(change: Callable[[list[list[str]]], list[list[str]]]) -> Callable[[Path], None]:
        return _edit("arm.csv", change)

    def exposures(change: Callable[[list[list[str]]], list[list[str]]]) -> Callable[[Path], None]:
        return _edit("exposures.csv", change)

    plate: dict[str, Callable[[Path], None]] = {
        "half-scan": exposures(lambda rows: rows[:7]),
        "few-scan": exposures(lambda rows: rows[:3]),
        "no-arm": lambda folder: (folder / "arm.csv").unlink(),
        "nan-arm": arm(lambda rows: [*rows[:5], *_set(rows[5:7], 1, "nan"), *rows[7:]]),
        "text-arm": arm(lambda rows: [*rows[:5], *_set(rows[5:6], 2, "north"), *rows[6:]]),
        "twice-arm": arm(lambda rows: [*rows, rows[-1]]),
        "swapped-arm": arm(lambda rows: [_swapped(rows[0]), *rows[1:]]),
        "no-rotation": arm(lambda rows: [row[:8] for row in rows]),
        "inches": arm(lambda rows: [rows[0], *map(_inches, rows[1:])]),
        "unknown-session": lambda folder: _append(
            folder / "session.toml", "\n[weather]\nsun = 1\n"
        ),
        "missing-image": lambda folder: (folder / "images/4.jpg").unlink(),
        "moved-view": exposures(lambda rows: [rows[0], *_set(rows[1:], -1, "same")]),
    }
    ball: dict[str, Callable[[Path], None]] = {
        "late-arm": arm(lambda rows: [rows[0], *rows[9:]]),
        "other-laser": exposures(lambda rows: [rows[0], *_set(rows[1:], 4, "Q")]),
        "no-time": exposures(lambda rows: [[*row[:1], *row[2:]] for row in rows]),
        "outside-path": exposures(lambda rows: [rows[0], *_set(rows[1:], 3, "../left/view0.jpg")]),
    }
    rest = {"half-ball": exposures(lambda rows: rows[:9])}
    for source, changes in (("plate-scan", plate), ("ball-scan", ball), ("ball-rest", rest)):
        for name, change in changes.items():
            shutil.copytree(workspace / source, bad / name)
            change(bad / name)


def _edit(
    name: str, change: Callable[[list[list[str]]], list[list[str]]]
) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        rows = [line.split(",") for line in (folder / name).read_text().splitlines()]
        (folder / name).write_text("\n".join(",".join(row) for row in change(rows)) + "\n")

    return edit


def _set(rows: list[list[str]], column: int, word: str) -> list[list[str]]:
    rows = [list(row) for row in rows]
    for row in rows:
        row[column] = word
    return rows


def _swapped(header: list[str]) -> list[str]:
    """Two columns of the rotation under each other's name: no rotation any more."""
    swap = {"r11": "r12", "r12": "r11"}
    return [swap.get(word, word) for word in header]


def _inches(row: list[str]) -> list[str]:
    return [row[0], *(repr(float(word) / 25.4) for word in row[1:4]), *row[4:]]


def _append(path: Path, text: str) -> None:
    path.write_text(path.read_text() + text)


DOCUMENTS = f"""
calibrate camera left/*.jpg {T} -o {D}/camera.json
calibrate camera right/*.jpg {T} -o {D}/right.json
calibrate stereo left right {T} -o {D}/stereo.json
calibrate laser --camera {D}/camera.json --on on/*.jpg --off off/*.jpg {T} -o {D}/sensor.json
calibrate laser --camera {D}/camera.json --on cross/*.jpg --off off/*.jpg {T} -o {D}/cross.json
calibrate laser --camera {D}/stereo.json --scan two-cameras {T} -o {D}/multi.json
calibrate hand-eye plate-scan --sensor {D}/sensor.json --plane 0.02,-0.01,1,-25 -o {D}/scanner.json
calibrate hand-eye --profiles profiles/p*.csv --poses profiles/poses.txt --sphere-diameter 80 -o {D}/profiles.json
reconstruct ball-scan --scanner {D}/scanner.json -o {D}/ball.ply
reconstruct plate-scan --scanner {D}/scanner.json -o {D}/plate.ply
register tables/view1.csv tables/view2.csv tables/view3.csv -o {D}/joined
markers plain/rings0.jpg plain/rings1.jpg --stereo {D}/stereo.json --diameter 6 -o {D}/markers.csv
"""
