"""The choice of a picture and its size; nothing heavy is imported for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.core.loop import Loop

if TYPE_CHECKING:
    from tailgate.envs.render.picture import Window

VIEWERS = ("auto", "plain", "highway")
SIZE = (960, 240)  # size of a picture on HighwayEnv's road [px]
SMALLEST, LARGEST = (400, 144), (3840, 2160)


@dataclass(frozen=True)
class Viewer:
    """name: "plain", "highway" (HighwayEnv's road), or "auto": highway where HighwayEnv is installed and cars drive, else plain.

    size (width, height) [px], even numbers, is that of a picture on HighwayEnv's road; None is 960 x 240.
    """

    name: str = "auto"
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.name not in VIEWERS:
            raise unknown("viewer", self.name, VIEWERS)
        if self.size is None:
            return
        if self.name == "plain":
            raise InputError("size", self.size, "none with viewer 'plain', whose picture is always 960 x 320")
        whole = isinstance(self.size, (tuple, list)) and len(self.size) == 2 and all(isinstance(n, (int, np.integer)) for n in self.size)
        if not whole or not all(low <= n <= high and n % 2 == 0 for n, low, high in zip(self.size, SMALLEST, LARGEST, strict=True)):
            least, most = (f"{w} x {h}" for w, h in (SMALLEST, LARGEST))
            raise InputError("size", self.size, f"(width, height) in pixels, even whole numbers from {least} to {most}")

    def on_road(self, loop: Loop) -> bool:
        """Return if this loop is drawn on HighwayEnv's road. Raise ImportError or NotApplicable where it is asked for and cannot be."""
        asked, drives = self.name == "highway" or self.size is not None, bool(loop.model.followers.any()) and not loop.model.lane
        if self.name == "plain" or not (drives or asked):
            return False
        if not drives:
            wanted = "cars that follow each other; 'plain' draws a network and a lane"
            raise NotApplicable("viewer", self.name if self.size is None else self.size, wanted)
        if find_spec("highway_env") is None:
            if asked:
                where = "pip install 'tailgate[highway,viz]' (viewer 'plain' does without)"
                raise ImportError(f"highway-env is missing, which draws the road: {where}")
            return False
        return True


class Screen:
    """The window of one environment in human mode: shows each picture once, and opens with the first."""

    def __init__(self) -> None:
        self._window: Window | None = None
        self._shown = -1

    def show(self, moves: int, fps: int, draw: Callable[[], Any]) -> None:
        """Show a picture (H, W, 3) uint8 of `draw`, unless the one after this number of resets and steps is shown already."""
        if moves == self._shown:
            return
        if self._window is None:
            from tailgate.envs.render.picture import Window

            self._window = Window(fps)
        if not self._window.dismissed:
            self._window.show(draw())
        self._shown = moves

    def close(self) -> None:
        """Close the window, if it is open; a later picture opens another."""
        if self._window is not None:
            self._window.close()
        self._window, self._shown = None, -1

    def __getstate__(self) -> dict[str, Any]:
        return {"_window": None, "_shown": -1}  # a copy opens a window for itself
