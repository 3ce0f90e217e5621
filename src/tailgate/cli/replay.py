"""tailgate replay: one episode again from its row, as a page and a film."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Literal

from tailgate.base.errors import InputError
from tailgate.cli.shared import Commands, own_classes, print_json, say, telling_aside, written


def add(commands: Commands) -> None:
    """Add `replay` to the commands."""
    command = commands.add_parser(
        "replay", help="play one episode again from its row and write a page of it",
        description="Play one episode again from its row, check its hash, and write one HTML page. Of the rows that the options leave, the "
        "one with the worst outcome is played: a crash first, then the smallest gap, then the largest error.",
    )  # fmt: skip
    command.add_argument("rows", metavar="ROWS.jsonl", help="rows of `tailgate evaluate` or `train`")
    which = command.add_mutually_exclusive_group()
    which.add_argument("--line", type=int, metavar="N", help="the row in this line, counted from 1")
    which.add_argument("--worst", action="store_true", help="the worst outcome of the rows that match (default)")
    command.add_argument("--defence", metavar="NAME", help="rows of this defence; needed to let a row import module:Class")
    command.add_argument("--attack", metavar="NAME", help="rows of this attack; also where a policy's file lies now")
    command.add_argument("--scenario", metavar="NAME", help="rows of this scenario; also where its YAML file lies now")
    command.add_argument("--dose", metavar="STEPS", help="rows with this attack budget, or none")
    command.add_argument("--seed", type=int, metavar="N", help="rows with this seed")
    command.add_argument("--agent", type=int, metavar="N", help="the car or agent to look at first (default: the one attacked most)")
    command.add_argument("--out", required=True, metavar="PATH", help="the page: a file that ends in .html, or a directory")
    command.add_argument("--video", metavar="FILE", help="also a film: .gif, .webp or .mp4")
    command.add_argument("--export", action="append", default=[], metavar="FILE",
                         help="also the episode: .csv, .parquet (needs tailgate[log]), or .xml of SUMO's cars (repeatable)")  # fmt: skip
    command.add_argument("--viewer", default="auto", choices=["auto", "plain", "highway"], help="what the film is drawn with")
    command.add_argument("--size", metavar="WxH", help="of a film on the road, for example 480x160 [px]")
    command.add_argument("--json", action="store_true", help="print what was played and checked as JSON")
    command.set_defaults(run=_replay)


def _dose(text: str | None) -> int | Literal["none"] | None:
    if text is None or text == "none":
        return "none" if text else None
    if not text.isdecimal():
        raise InputError("--dose", text, "a whole number of attack steps, or none")
    return int(text)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError("--size", text, "width x height in pixels, such as 480x160")
    return int(width), int(height)


def _replay(options: argparse.Namespace) -> int:
    from tailgate.core.registry import Spec
    from tailgate.envs.render.viewer import Viewer
    from tailgate.evaluation.rows import read_rows
    from tailgate.replay.page import failed, outcome, page_at, write_page
    from tailgate.replay.replay import Filter, choose, play

    video = Path(options.video) if options.video else None
    if video is not None:
        from tailgate.replay.video import check_format, write_video

        check_format(video)
    elif options.size is not None or options.viewer != "auto":
        raise InputError("--video", None, "a file: --viewer and --size are those of a film")
    from tailgate.roads.export import check_path, write_episode

    for file in options.export:
        check_path(Path(file))
        written("--export", file)
    written("--video", options.video)
    place = page_at(Path(options.out))
    written("--out", str(place))
    viewer = Viewer(options.viewer, _size(options.size))
    defence = Spec("defence", options.defence or "none")
    if defence.imports or defence.sandboxed or Spec("attack", options.attack or "none").imports:
        own_classes()  # of what the user names; a row's own text imports nothing
    wanted = Filter(options.line, options.scenario, options.defence, options.attack, _dose(options.dose), options.seed)
    source = Path(options.rows)
    chosen = choose(read_rows(source), wanted)
    replay = play(chosen.row, wanted)
    with telling_aside(place):
        page = write_page(replay, place, f"line {chosen.line} of {source.name}", options.agent)
    exports = [write_episode(replay.trace, Path(file)) for file in options.export]
    film = write_video(replay, video, viewer) if video is not None else None
    row = chosen.row
    report = {
        "line": chosen.line, "matched": chosen.matched, "chosen": chosen.why,
        **{key: row[key] for key in ("scenario", "defence", "attack", "dose", "purpose", "seed")},
        "outcome": outcome(replay), "failed": failed(row), "verdict": replay.verdict,
        "trace_hash": replay.checks[0].here, "decision_hash": replay.checks[1].here,
        "differences": [{"name": c.name, "row": c.row, "here": c.here} for c in replay.differences],
        "metrics": replay.metrics, "page": str(page), "video": str(video) if video is not None else None,
        "exports": list(map(str, exports)),
    }  # fmt: skip
    if options.json:
        print_json(report)
    else:
        _print(report, film)
    return 1 if replay.verdict in ("different", "figures") else 0


def _print(report: dict[str, Any], film: str | None) -> None:
    from tailgate.replay.page import VERDICTS

    _, title, why = VERDICTS[report["verdict"]]
    matched = "" if report["matched"] == 1 else f" of {report['matched']} that match"
    lines = [
        ("row", f"line {report['line']}, {report['chosen']}{matched}"),
        ("played", f"{report['defence']} against {report['attack']}, {report['scenario']}, seed {report['seed']} ({report['purpose']})"),
        ("outcome", report["outcome"]),
        *(("failed", f"{held['property']}: {held['about']}, as the row says") for held in [report["failed"]] if held),
        ("check", f"{title}: {why}"),
        *(("", f"{d['name']}: row {d['row'] or 'not recorded'}, here {d['here'] or 'none'}") for d in report["differences"]),
        ("page", report["page"]),
    ]  # fmt: skip
    if film is not None:
        lines.append(("video", film))
    lines += [("export", path) for path in report["exports"]]
    for name, words in lines:
        say(f"{name:<8}{words}", soft_wrap=True)
