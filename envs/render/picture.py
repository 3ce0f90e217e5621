"""One picture of one episode for render_mode "rgb_array", and the window that shows it for "human" (extra: viz).

Colour is never the only sign, the same state always gives the same picture, and no picture changes a state.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.extras import optional
from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.core.registry import entry_for
from tailgate.envs.render import following as render_following
from tailgate.envs.render import lane as render_lane
from tailgate.envs.render import network as render_network
from tailgate.envs.render import platoon as render_platoon
from tailgate.envs.render import radar as render_radar
from tailgate.envs.render.canvas import HEIGHT as HEIGHT
from tailgate.envs.render.canvas import WIDTH as WIDTH
from tailgate.envs.render.viewer import Viewer

AUTO = Viewer()


def plain(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return (HEIGHT, WIDTH, 3) uint8: the road from the side, a lane from above, or the graph of a network. Arguments as of `draw`."""
    if not loop.model.followers.any():
        return render_network.draw(loop, state, frame, row)
    if loop.model.lane:
        return render_lane.draw(loop, state, frame, row)
    if loop.model.agents > 1:
        return render_platoon.draw(loop, state, frame, row)
    if loop.model.air:
        return render_radar.draw(loop, state, frame, row)
    return render_following.draw(loop, state, frame, row)


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int, viewer: Viewer = AUTO, caption: str = "") -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`. frame is None right after a reset, also of other rows.

    caption: a line about who plays, on HighwayEnv's road; the defence's name where nothing is said.
    """
    if not viewer.on_road(loop):
        return plain(loop, state, frame, row)
    from tailgate.envs.render import highway as render_highway

    caption = caption or f"defence {entry_for('defence', type(loop.defence)).name}"
    return render_highway.draw(loop, state, frame, row, viewer.size, caption)


class Window:
    """A window on the screen, opened by its first picture, which fills it as far as it can. One that its reader has closed stays closed."""

    shown: ClassVar[tuple[int, int] | None] = None  # size of the pictures that the one display was opened for

    def __init__(self, fps: int) -> None:
        self.fps = fps
        self.open = False
        self.dismissed = False  # by its reader
        self._pygame: Any = None
        self._clock: Any = None

    def show(self, picture: Array) -> None:
        """Show a picture (H, W, 3) uint8, no sooner than the frame rate allows. Raises InputError where there is no screen."""
        if self.dismissed:
            return
        size = (picture.shape[1], picture.shape[0])
        screen = self._pygame.display.get_surface() if self.open else None
        if screen is None or Window.shown != size:  # also where another environment has closed or changed the one display
            self._start(size)
        pygame = self._pygame
        if any(event.type in (pygame.QUIT, pygame.WINDOWCLOSE) for event in pygame.event.get()):
            self.dismissed = True
            self.close()
            return
        screen = pygame.display.get_surface()
        image, room = pygame.image.frombuffer(np.ascontiguousarray(picture), size, "RGB"), screen.get_size()
        if room != size:  # its reader has made it larger or smaller
            scale = min(room[0] / size[0], room[1] / size[1])
            image = pygame.transform.smoothscale(image, (max(1, round(size[0] * scale)), max(1, round(size[1] * scale))))
            screen.fill(0)
        screen.blit(image, ((room[0] - image.get_width()) // 2, (room[1] - image.get_height()) // 2))
        pygame.display.flip()
        self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if it is open."""
        if self.open:
            self.open = False
            self._pygame.display.quit()

    def _start(self, size: tuple[int, int]) -> None:
        pygame = optional("pygame", "viz", "pygame is missing, which opens the window")
        try:
            pygame.display.init()
            pygame.display.set_mode(size, pygame.RESIZABLE)
        except pygame.error as error:
            raise InputError("render_mode", "human", f"a screen for the window ({error}); 'rgb_array' needs none") from None
        pygame.display.set_caption("Tailgate")
        self._pygame, self._clock, self.open, Window.shown = pygame, pygame.time.Clock(), True, size
