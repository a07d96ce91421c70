# SPDX-License-Identifier: Apache-2.0
"""What the console's column says, as HTML: the steps, a scan while it runs, a step's result."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import cast

from armscan.calibration.cameras.pairs import SIDES
from armscan.console.journey import WORDS, Status, StepResult, StepState
from armscan.console.quality import ModelWatch
from armscan.console.scan import LiveScan
from armscan.console.scene import paragraph
from armscan.pipeline.live.session import LiveSnapshot, LiveStatus
from armscan.report.drawing import ACCENT, ALERT, INK, LINE, MUTED
from armscan.report.quantity import sentence

GOOD, WRONG = "#3f7d2b", "#b3261e"
TINTS = {"good": GOOD, "doubtful": "#b07d12", "not good": WRONG, "old": "#b07d12"}


def overview(session: str, rig: str, states: Mapping[str, tuple[Status, bool]], link: str) -> str:
    """HTML of a session's steps: of each its status, and whether it is the one that is shown.

    ``link`` is the HTML of the way to the report.
    """
    rows = []
    for title, (status, is_shown) in states.items():
        tint = TINTS.get(status, MUTED if status != "ready" else ACCENT)
        weight = "600" if is_shown else "400"
        hollow = status in ("waiting", "open")
        dot = (
            f'<span style="display:inline-block;width:10px;height:10px;border-radius:50%;'
            f"border:2px solid {tint};box-sizing:border-box;margin-right:8px;"
            f'background:{"transparent" if hollow else tint}"></span>'
        )
        rows.append(
            f'<div style="display:flex;align-items:center;font-weight:{weight};'
            f'padding:1px 0">{dot}<span>{escape(title)}</span>'
            f'<span style="margin-left:auto;color:{tint}">{WORDS[status]}</span></div>'
        )
    return (
        f'<div style="font-size:14px;color:{INK};line-height:1.45">'
        f'<div style="font-size:16px;font-weight:700">{escape(session)}</div>'
        f'<div style="font-size:11px;color:{MUTED};overflow-wrap:anywhere;margin-bottom:6px">'
        f"{escape(rig)}</div>{''.join(rows)}"
        f'<div style="margin-top:6px">{link}</div></div>'
    )


def live_facts(live: LiveScan, shown: LiveSnapshot, model: ModelWatch | None) -> str:
    """HTML of how a scan goes: what is wrong with it now, and what it has so far."""
    drift = live.drift_mm()
    late = "" if shown.latency_ms is None else f", shown after {shown.latency_ms[0]:.0f} ms"
    lines = [
        f"{live.n_recorded} exposures recorded, {shown.rate_hz:.1f} a second{late}",
        f"passes: {shown.n_passes}, points: {shown.n_points:,}",
        "passes do not meet yet"
        if drift is None
        else f"the last pass lies {drift:.3f} mm from the earlier ones (median)",
    ]
    for k, lines_seen in enumerate(shown.brightness):
        camera = f"{SIDES[k]} camera" if len(shown.brightness) > 1 else "exposure"
        lines += [f"{camera}: {'; '.join(one.words for one in lines_seen)}"] if lines_seen else []
    still = shown.counts.get(LiveStatus.STILL, 0)
    lines += [f"{still} dropped while the hand was still"] if still else []
    # a simulated hand waits until its images are rendered: its times tell nothing
    is_device = not live.bench.has_operator
    lines += [words for words in shown.streams if words and is_device]
    lost = [
        f"{n} {status.value}"
        for status, n in shown.counts.items()
        if status not in (LiveStatus.PLACED, LiveStatus.STILL)
    ]
    lines += [", ".join(lost)] if lost else []
    if live.bench.is_over:
        lines.append("the simulated hand has come to its end: finish")
    alerts = ["Paused: nothing is recorded."] if shown.state == "paused" else []
    alerts += [model.problem] if model is not None and model.problem else []
    if shown.state == "scanning" and is_device:
        alerts += [
            f"{sentence(fault)} The scan goes on by itself when it answers again."
            for fault in shown.faults
        ]
    if shown.state == "scanning" and not live.is_timed:
        alerts.append(
            "The devices' clocks are not known yet: what is recorded now cannot be placed. Wait; "
            "if this stays, take more images a second."
        )
    if shown.state == "scanning" and not live.session.is_recording:
        alerts.append("Nothing is recorded any more: finish, and see to the disk.")
    return "".join(
        [paragraph(text, ALERT, 14) for text in alerts]
        + [paragraph(line, INK, 13) for line in lines]
    )


def result_card(state: StepState, link: str) -> str:
    """HTML of what a step's job said."""
    result = cast(StepResult, state.result)
    tint = TINTS[state.status if state.status in TINTS else result.verdict]
    title = WORDS[state.status] if state.status in TINTS else WORDS[result.verdict]
    rows = "".join(
        f'<tr><td style="color:{MUTED};padding:2px 8px 2px 0;vertical-align:top">'
        f'{escape(label.strip())}</td><td style="padding:2px 0;white-space:pre-line">'
        f"{escape(text)}</td></tr>"
        for label, text in result.values
    )
    reasons = "".join(paragraph(text, INK, 13) for text in result.reasons)
    old = state.status == "old"
    why = paragraph(sentence(state.why), ALERT, 13) if state.why else ""
    figures = (
        f'<details open><summary style="cursor:pointer;color:{MUTED}">Figures</summary>'
        f'<table style="font-size:12px;border-collapse:collapse">{rows}</table></details>'
    )
    return (
        f'<div style="border:1px solid {LINE};border-left:5px solid {tint};border-radius:4px;'
        f'padding:8px 10px;margin:6px 0;color:{INK};font-size:13px">'
        f'<div style="font-size:15px;font-weight:700;color:{tint}">{title.capitalize()}</div>'
        f"{why}{reasons}{paragraph('' if old else result.next_step, INK, 13)}"
        f"{figures if rows else ''}{link}</div>"
    )


def padded(content: str) -> str:
    """HTML as far from the column's edges as the controls."""
    return f'<div style="padding:2px 18px 2px 10px">{content}</div>'
