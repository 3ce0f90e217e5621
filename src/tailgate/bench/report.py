"""A record for people: tables, a page in Markdown, and plots of the scalings (extra: viz)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic, write_json
from tailgate.base.reading import load_json

from .lines import BYTES, NUMBER, RATE, SECONDS, SHARE

RECORD, PAGE = "speed.json", "speed.md"
Record = dict[str, Any]


def shown(value: float, unit: str) -> str:
    """Return a figure with three digits and its unit."""
    if unit == RATE:
        for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
            if value >= 0.9995 * size:
                return f"{_digits(value / size)} {letter}/s"
        return f"{_digits(value)} /s"
    if unit == SECONDS:
        return f"{_digits(value)} s"
    if unit == BYTES:
        return f"{value:.0f} bytes"
    if unit == SHARE:
        return f"{100.0 * value:.1f} %"
    return f"{value:.3g}"


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 99.95 else f"{value:.1f}" if value >= 9.995 else f"{value:.2f}"


def _ratio(value: float) -> str:
    return f"{_digits(value) if value >= 0.1 else f'{value:.2g}'} x"


def figure(target: Record, record: Record, key: str = "value") -> str:
    """Return a target's figure, or one end of its interval."""
    if target[key] is None:
        return ""
    if target["right"] is not None:
        return _ratio(target[key])
    return shown(target[key], record["lines"][target["left"]]["unit"])


def bound(target: Record, record: Record) -> str:
    """Return what is asked."""
    if target["bound"] is None:
        return ""
    unit = record["lines"].get(target["left"], {}).get("unit", NUMBER)
    words = f"{target['bound']:g} x" if target["right"] is not None else shown(target["bound"], unit)
    return f"at {target['at']} {words}"


def verdict(target: Record) -> str:
    """Return met, missed, nothing if nothing is asked, or why the figure is not known."""
    if target["value"] is None:
        return f"not measured: {target['why']}"
    return "" if target["met"] is None else "met" if target["met"] else "missed"


def between(target: Record, record: Record) -> str:
    """Return the interval over rounds."""
    if target["value"] is None or target["low"] == target["high"]:
        return ""
    return f"{figure(target, record, 'low')} to {figure(target, record, 'high')}"


def quartiles(line: Record) -> str:
    """Return the spread of a line's rounds; empty where all are equal."""
    return "" if line["q25"] == line["q75"] else f"{shown(line['q25'], line['unit'])} to {shown(line['q75'], line['unit'])}"


def judged(target: Record, record: Record) -> tuple[str, str, str, str, str]:
    """Return a target as people read it: what, figure, interval, bound, verdict."""
    return target["what"], figure(target, record), between(target, record), bound(target, record), verdict(target)


def _table(title: str, *heads: str) -> Table:
    table = Table(title=title)
    for head in heads:
        table.add_column(head, overflow="fold")
    return table


def print_tables(record: Record, out: Console) -> None:
    """Print lines, then targets, on a console."""
    table = _table(f"medians of {record['rounds']} rounds of {record['seconds']:g} s", "line", "what", "median", "quartiles")
    for name, line in record["lines"].items():
        table.add_row(name, escape(line["what"]), shown(line["median"], line["unit"]), quartiles(line))
    if record["lines"]:
        out.print(table)
    if record["targets"]:
        table = _table("targets", "target", "what", "measured", "interval", "asked", "verdict")
        for target in record["targets"]:
            table.add_row(target["name"], *map(escape, judged(target, record)))
        out.print(table)
    for plot in record["scalings"]:
        table = _table(escape(plot["what"]), *map(escape, (plot["axis"], *plot["curves"])))
        sizes = sorted({point["at"] for curve in plot["curves"].values() for point in curve})
        for n in sizes:
            at = [next((shown(p["median"], RATE) for p in curve if p["at"] == n), "") for curve in plot["curves"].values()]
            table.add_row(str(n), *at)
        out.print(table)
    for name, why in record["missing"].items():
        out.print(f"missing: {name}: {why}", markup=False, highlight=False)


def page(record: Record, plots: list[str]) -> str:
    """Return the record as a page in Markdown; `plots` are the names of the pictures in the same folder."""
    machine = record["machine"]
    packages = ", ".join(f"{name} {number}" for name, number in machine["packages"].items())
    load = "" if record["load"] is None else f" The load over the last minute was {record['load'][0]} at the end."
    sure = min((target["coverage"] for target in record["targets"] if target["coverage"]), default=0.0)
    covers = f" An interval covers its median with {100.0 * sure:.0f} % or more." if sure else ""
    out = [
        "# Speed", "", "Written by `tailgate bench`; docs/speed.md says how it is measured.", "",
        f"{machine['processor']} ({machine['vectors']}), {machine['cores']} cores, {machine['system']}, Python {machine['python']}, "
        f"{packages}; compiler: {machine['compiler'] or 'none'}. "
        f"tailgate {record['version']}, commit {record['commit'] or 'unknown'}, {record['date']}. "
        f"Medians of {record['rounds']} rounds of {record['seconds']:g} s.{covers}{load}", "",
        "## Targets", "", "| what | measured | interval over rounds | asked | |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for target in record["targets"]:
        out.append(f"| {' | '.join(judged(target, record))} |")
    out += ["", "## Lines", "", "| what | median | quartiles |", "|---|---|---|"]
    for line in record["lines"].values():
        counted = f", {line['of']}" if line["unit"] == RATE and line["of"] != "steps" else ""
        out.append(f"| {line['what']}{counted} | {shown(line['median'], line['unit'])} | {quartiles(line)} |")
    if record["missing"]:
        out += ["", "## Not measured", "", *(f"- {name}: {why}" for name, why in record["missing"].items())]
    if plots:
        out += ["", "## Scaling"]
        for plot in record["scalings"]:
            name = plot_name(plot)
            if name in plots:
                out += ["", f"![{plot['what']}]({name})"]
    return "\n".join(out) + "\n"


def plot_name(plot: Record) -> str:
    """Return the file name of a plot."""
    return f"speed-{plot['name'].removeprefix('scaling-')}.png"


def draw(plot: Record) -> bytes:
    """Draw one scaling as a picture: medians, and quartiles as bars."""
    from matplotlib.ticker import NullLocator

    from tailgate.base.plots import MARKERS, canvas, png

    made, axes = canvas(6.4, 4.2)
    ax = axes[0, 0]
    sizes = sorted({point["at"] for curve in plot["curves"].values() for point in curve})
    for i, (name, curve) in enumerate(plot["curves"].items()):
        x, y = [p["at"] for p in curve], [p["median"] for p in curve]
        spread = [[p["median"] - p["q25"] for p in curve], [p["q75"] - p["median"] for p in curve]]
        ax.errorbar(x, y, spread, marker=MARKERS[i], markersize=5, capsize=3, label=name, color=f"C{i}")
    if plot["axis"] == "cores":
        for curve in plot["curves"].values():  # what as many cores would do if none waited for another
            ax.plot(sizes, [curve[0]["median"] * n / curve[0]["at"] for n in sizes], ":", color="grey", label="in proportion")
        ax.set_ylim(bottom=0.0)
        ax.set_xlim(0.5, max(sizes) + 0.5)
    else:
        ax.set(xscale="log", yscale="log")
    ax.set_xticks(sizes, [str(n) for n in sizes], minor=False)
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set(xlabel=plot["axis"], ylabel="steps per second")
    ax.set_title(plot["what"], fontsize=10)
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8, loc="lower right" if plot["axis"] == "episodes" else "lower left")
    return png(made)


def check_place(directory: Path, wanted: set[str]) -> None:
    """Raise InputError where a record of more lines or plots would be overwritten, or nothing can be written."""
    writable_directory(directory)
    try:
        held = load_json(directory / RECORD)
        more = {*held["lines"], *held["missing"], *(plot["name"] for plot in held["scalings"])} - wanted
    except (OSError, ValueError, KeyError, TypeError):
        return
    if more:
        expected = f"another directory: this one holds a record with more ({len(more)} lines that --only leaves out)"
        raise InputError("out", str(directory), expected)


def write(record: Record, directory: Path) -> tuple[list[Path], str | None]:
    """Write the record, its page and its plots; return the paths, and why there are no plots."""
    paths, plots, why = [], [], None
    for plot in record["scalings"]:
        if not plot["curves"]:
            continue
        try:
            picture = draw(plot)
        except ImportError as error:
            why = f"no plots: {error}"
            break
        write_atomic(directory / plot_name(plot), picture)
        plots.append(plot_name(plot))
        paths.append(directory / plot_name(plot))
    write_atomic(directory / PAGE, page(record, plots).encode())
    write_json(directory / RECORD, record)
    return [directory / RECORD, directory / PAGE, *paths], why
