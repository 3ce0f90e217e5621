"""Plots of an evaluation: position errors and gaps, for each defence and attack."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.base.errors import unknown
from tailgate.base.extras import optional
from tailgate.base.files import writable_directory, write_atomic
from tailgate.base.pytree import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Table = Sequence[dict[str, Any]]  # from evaluation.summary.summarise
PANELS = (  # key, title, colours from harmless to harmful
    ("rmse_position", "position RMSE [m], median", "Blues"),
    ("min_gap", "smallest gap [m], median", "Oranges_r"),
    ("crash", "episodes with a collision [%]", "Reds"),
)
NO_ROAD = (  # for systems without a road
    ("rmse_position", "RMS of the state's error (2-norm), median", "Blues"),
    ("max_error", "largest error of an agent's state (2-norm), median", "Purples"),
)
FORMS: dict[str, dict[str, None]] = {  # of pictures, and what a file says of its making: nothing that differs from call to call
    "png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}  # fmt: skip
MARKERS = "osD^v<>PX*phd"


def canvas(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, Array]:
    """Return a matplotlib figure and its axes (rows, columns), without the global state of pyplot."""
    figure = optional("matplotlib.figure", "viz", "figures need matplotlib").Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def drawn(figure: Figure, form: str = "png", salt: str = "tailgate", dpi: int = 110) -> bytes:
    """Return the figure as a file; equal figures give equal bytes.

    Parameters
    ----------
    figure
        Of matplotlib.
    form
        One of `FORMS`.
    salt
        Text that the names of parts in an SVG come from.
    dpi
        Dots per inch of a PNG.

    Raises
    ------
    InputError
        For another form.
    """
    if form not in FORMS:
        raise unknown("picture", form, FORMS)
    import matplotlib

    out = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": salt}):
        figure.savefig(out, format=form, metadata=FORMS[form], dpi=dpi if form == "png" else "figure")
    return out.getvalue()


def png(figure: Figure) -> bytes:
    """Return the figure as a PNG file; equal figures give equal bytes."""
    return drawn(figure)


def write_overview(table: Table, directory: Path, form: str = "png") -> list[Path]:
    """Write matrices for each scenario and dose, and one scatter plot of all cells with a road; return the paths. form: as of `drawn`."""
    writable_directory(directory, "plot")
    good = [entry for entry in table if entry["crash"] is not None]
    out = []
    for scenario, dose in dict.fromkeys((e["scenario"], e["dose"]) for e in good):
        here = [e for e in good if (e["scenario"], e["dose"]) == (scenario, dose)]
        name = re.sub(r"[^\w.-]+", "-", f"{scenario}-{'unlimited' if dose is None else dose}.{form}")
        out.append(directory / name)
        title = f"{scenario}, budget {'unlimited' if dose is None else f'{dose} steps'}"
        write_atomic(out[-1], drawn(matrix_figure(here, title), form))
    road = [entry for entry in good if entry["min_gap"]]
    if road:
        out.append(directory / f"rmse-against-gap.{form}")
        write_atomic(out[-1], drawn(scatter_figure(road), form))
    return out


def value(entry: dict[str, Any], key: str) -> float:
    """Return a figure of one cell as it is drawn; NaN if the cell has none."""
    if key == "crash":
        return 100.0 * float(entry["crash"]["value"])
    return float(entry[key]["median"]) if entry[key] else float("nan")


def matrix_figure(table: Table, title: str) -> Figure:
    """Return matrices of defences by attacks: position error, smallest gap, collisions; without a road, state errors."""
    panels = PANELS if any(entry["min_gap"] for entry in table) else NO_ROAD
    defences, attacks = (list(dict.fromkeys(e[key] for e in table)) for key in ("defence", "attack"))
    labels = [textwrap.fill(name.replace(",", ", "), 26) for name in attacks]
    width = max(4.5, 0.52 * len(attacks)) + 0.075 * max(len(name) for name in defences)
    size = width, 2.6 + len(panels) * (0.5 + 0.27 * len(defences))
    figure, axes = canvas(*size, len(panels), 1, sharex=True)
    for ax, (key, words, colours) in zip(axes[:, 0], panels, strict=True):
        grid = np.full((len(defences), len(attacks)), np.nan)
        for entry in table:
            grid[defences.index(entry["defence"]), attacks.index(entry["attack"])] = value(entry, key)
        shade = np.log10(np.maximum(grid, 1e-2)) if key in ("rmse_position", "max_error") else grid
        shade = np.clip(shade, 0.0, 20.0) if key == "min_gap" else shade
        low, high = {"crash": (0.0, 100.0), "min_gap": (0.0, 20.0)}.get(key, (np.nanmin(shade), np.nanmax(shade) + 1e-9))
        image = ax.imshow(shade, cmap=colours, aspect="auto", vmin=low, vmax=high)
        for (i, j), number in np.ndenumerate(grid):
            if np.isfinite(number):
                dark = sum(image.cmap(image.norm(shade[i, j]))[:3]) < 1.5
                ax.text(j, i, _short(number), ha="center", va="center", fontsize=7, color="white" if dark else "black")
        ax.set_title(words, fontsize=10)
        ax.set_xticks(range(len(attacks)), labels, rotation=90, fontsize=7)
        ax.set_yticks(range(len(defences)), defences, fontsize=8)
    figure.suptitle(title)
    return figure


def _short(number: float) -> str:
    return f"{number:.0f}" if abs(number) >= 9.95 else f"{number:.1f}" if abs(number) >= 0.05 else "0"


def scatter_figure(table: Table) -> Figure:
    """Return position error against smallest gap, one mark per cell; filled marks are cells where most episodes collide."""
    figure, axes = canvas(10.0, 5.8)
    ax, defences = axes[0, 0], list(dict.fromkeys(e["defence"] for e in table))
    for i, name in enumerate(defences):
        cells = [e for e in table if e["defence"] == name]
        x, y = (np.array([value(e, key) for e in cells]) for key in ("rmse_position", "min_gap"))
        hit = np.array([value(e, "crash") for e in cells]) > 50.0
        style = {"marker": MARKERS[i % len(MARKERS)], "color": f"C{i % 10}", "s": 30}
        ax.scatter(x[~hit], y[~hit], facecolors="none", edgecolors=style["color"], marker=style["marker"], s=30, label=name)
        ax.scatter(x[hit], y[hit], **style)
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set_yscale("symlog", linthresh=10.0)
    ticks = [-10, -5, 0, 5, 10, 20, 50, 100]
    ax.set_yticks(ticks, [str(tick) for tick in ticks])
    ax.set_ylim(min(-2.0, 1.2 * min(value(e, "min_gap") for e in table)), 120.0)
    ax.set(xscale="log", xlabel="position RMSE [m], median", ylabel="smallest gap [m], median (above 10 m: logarithmic)")
    ax.set_title(f"Error against gap: rank correlation {_rank_correlation(table):+.2f}\nfilled: most episodes collide", fontsize=10)
    ax.grid(alpha=0.3, which="both")
    figure.legend(loc="outside lower center", fontsize=8, ncols=3)
    return figure


def _rank_correlation(table: Table) -> float:
    from scipy.stats import spearmanr

    pairs: Array = np.array([(value(e, "rmse_position"), value(e, "min_gap")) for e in table])
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    return float(spearmanr(pairs[:, 0], pairs[:, 1]).statistic) if len(pairs) > 2 else float("nan")
