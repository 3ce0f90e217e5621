"""The bars above and below a picture on the road: time, attack, alarm; figures, who plays, the radar (extra: viz)."""

from __future__ import annotations

from tailgate.core import Frame, Kind
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.render.canvas import ATTACK, COMMANDS, EGO, GREY, INK, PALE, WARNING, WHITE, aimed, alarmed, metres
from tailgate.envs.render.sheet import Sheet
from tailgate.envs.render.stage import Stage

NOISE_FLOOR = -90.0  # lower powers are shown as silence [dB]


def _signed(value: float) -> str:
    """Return one decimal place with its sign; a value that rounds to nothing is +0.0."""
    return f"{round(value, 1) + 0.0:+,.1f}"


def upper(sheet: Sheet, loop: Loop, state: LoopState, frame: Frame | None, row: int) -> None:
    """Draw time, attack, attack steps left, alarm."""
    width, dt, steps, last = sheet.width, loop.model.dt, int(state.k[row]) - 1, state.channel.last
    fresh = frame is not None and frame.k[row] + 1 == state.k[row]
    refused = frame is not None and fresh and bool(frame.refused[row])
    kind = Kind(int(last.kind[row]))
    title, does = COMMANDS[kind]
    sheet.box(0, 0, width, sheet.bar, PALE)
    on, left = kind != Kind.NONE, 0.15 * width
    room, low = (5.0, left - 5.0), sheet.bar - 3.0 - 3.5 * sheet.unit
    sheet.text(5.0, sheet.big + 3.0, f"t = {steps * dt:.{1 if dt >= 0.1 else 2}f} s", INK, sheet.big, bold=True, room=room)
    budget = [f"step {steps} of {loop.horizon}", f"step {steps}"]
    if loop.threat.budget is not None:
        share = f"{loop.threat.budget - int(state.channel.used[row])} of {loop.threat.budget}"
        budget = [f"attack steps left: {share}", f"left: {share}"]
    line = next((line for line in budget if sheet.length(line, sheet.small) <= left - 10.0), budget[-1])
    sheet.text(5.0, low, line, GREY, sheet.small, room=room)
    words = title + (" (a command was refused)" if refused else "")
    sheet.chip(left, 0.66 * width, words, does + aimed(loop, last, row), ATTACK if on else WHITE, WHITE if on else GREY, on)
    alarm, second = bool(state.estimate.alarm[row].any()), alarmed(loop, state, row)
    size = 0.36 * sheet.bar
    sheet.chip(0.67 * width, width - 3.0, "", "", WARNING if alarm else WHITE, INK, alarm)
    sheet.alarm(0.67 * width + size + 4.0, sheet.bar / 2, size - 3.0, alarm)
    room = (0.67 * width + 2 * size + 4.0 + 4.0 * sheet.unit, width - 8.0)
    first = sheet.big + 3.0 if second else (sheet.bar + sheet.big) / 2 - 2.0
    sheet.text(room[0], first, "ALARM" if alarm else "no alarm", INK if alarm else GREY, sheet.big, bold=alarm, room=room)
    sheet.text(room[0], low, second, INK, sheet.small, room=room)


def lower(sheet: Sheet, stage: Stage, caption: str, note: str) -> None:
    """Draw the figures of the watched car, the caption, and the radar's part in the step."""
    follower, width, right = stage.followers[stage.watched], float(sheet.width), sheet.width - 5.0
    sheet.box(0, sheet.below, width, sheet.height, PALE)
    if follower.muted is not None:
        heard = f"heard {_signed(follower.heard)} dB over the noise" if follower.heard > NOISE_FLOOR else "heard nothing"
        first, second = ("CHALLENGE: radar silent", heard) if follower.muted else ("radar transmits", "")
        right = 0.67 * width
        fill, ink = (EGO, WHITE) if follower.muted else (WHITE, GREY)
        sheet.chip(right, width - 3.0, first, second, fill, ink, follower.muted, False)
        right -= 6.0
    who = "" if len(stage.followers) == 1 else f"{stage.cars[follower.car].name}: "
    figures = f"{who}gap {metres(follower.gap)}"
    if follower.believed is None:
        figures += ", nothing measured yet"
    else:
        figures += f", believed {metres(follower.believed)} ({_signed(follower.believed - follower.gap)} m)"
    figures += f", speed {stage.cars[follower.car].speed:.1f} m/s"
    room = (5.0, right)
    sheet.text(5.0, sheet.below + sheet.big + 2.0, figures, INK, sheet.big, bold=True, room=room)
    sheet.text(5.0, sheet.height - 5.5 * sheet.unit, note or caption, INK if note else GREY, sheet.small, bold=bool(note), room=room)
