"""A film of a replay: the pictures of `tailgate.envs.render.picture`, step by step (extra: viz)."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any

from tailgate.base.errors import InputError, NotWritable
from tailgate.base.files import replacing, writable_directory, write_atomic
from tailgate.board.words import names_of
from tailgate.core import Array
from tailgate.envs.render.viewer import Viewer

from .replay import Replay, episode

FORMATS = {".gif": "GIF", ".webp": "WEBP", ".mp4": "MP4"}
FASTEST = 20  # frames a second
MOST = 600  # frames of an animated picture, which is built in memory
SHORTEST = 10.0  # [s]; a shorter episode is slowed down
HOLD = 2.0  # [s] that the last frame stays
AUTO = Viewer()


def check_format(path: Path) -> None:
    """Raise InputError for an unknown format, ImportError for a missing encoder."""
    if path.suffix.lower() not in FORMATS:
        raise InputError("--video", str(path), f"a file that ends in {', '.join(FORMATS)}")
    if FORMATS[path.suffix.lower()] == "MP4" and find_spec("imageio_ffmpeg") is None:
        raise ImportError("MP4 needs imageio-ffmpeg: pip install 'tailgate[video]' (.gif and .webp do not)")
    from tailgate.envs.render import picture as render  # noqa: F401 - the import error names the extra if Pillow is missing


def pace(dt: float, length: int, most: float = math.inf) -> tuple[int, float]:
    """Return (steps per frame, frames a second): real time, but every step of an episode shorter than ten seconds."""
    stride = 1 if length * dt < SHORTEST else max(1, math.ceil(1.0 / (dt * FASTEST) - 1e-9), math.ceil(length / most))
    return stride, min(1.0 / (dt * stride), float(FASTEST))


def frames(replay: Replay, stride: int, viewer: Viewer = AUTO) -> Iterator[Array]:
    """Yield pictures (H, W, 3) uint8 of the start, every `stride`-th step and the last one, with the players' names."""
    from tailgate.envs.render.picture import draw

    last, row = int(replay.trace.length[0]), replay.row
    texts = names_of([row["defence"], row["attack"]])  # of a file its name, not its path
    caption = f"{row['scenario']}: {texts[row['defence']].full} against {texts[row['attack']].full}"
    for step, (state, frame) in enumerate(episode(replay.loop, replay.attack, replay.keys)):
        if step % stride == 0 or step == last:
            yield draw(replay.loop, state, frame, 0, viewer, caption)


def write_video(replay: Replay, path: Path, viewer: Viewer = AUTO) -> str:
    """Write the film in the format of the file's suffix; return a sentence about it."""
    check_format(path)
    dt, length = replay.trace.dt, int(replay.trace.length[0])
    kind = FORMATS[path.suffix.lower()]
    stride, rate = pace(dt, length, math.inf if kind == "MP4" else MOST)
    pictures = frames(replay, stride, viewer)
    count = len(range(0, length, stride)) + 1
    if kind == "MP4":
        _write_mp4(pictures, path, rate)
    else:
        _write_animation(pictures, path, kind, rate, count)
    speed = rate * stride * dt
    return f"{path} ({count} frames, {rate:g} a second{'' if abs(speed - 1.0) < 0.01 else f', at {speed:.2g} times the real speed'})"


def _write_animation(pictures: Iterator[Array], path: Path, kind: str, rate: float, count: int) -> None:
    from PIL import Image

    def reduced(picture: Array) -> Any:  # 256 colours per picture suffice for drawings, and save two thirds of the memory
        return Image.fromarray(picture).quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)

    pause = round(1000.0 / rate)
    durations = [pause] * (count - 1) + [round(1000.0 * HOLD)]
    options: dict[str, Any] = {"lossless": True, "method": 2, "quality": 40} if kind == "WEBP" else {"optimize": False}
    out = BytesIO()
    first = reduced(next(pictures))
    first.save(out, kind, save_all=True, append_images=[reduced(picture) for picture in pictures], duration=durations, loop=0, **options)
    write_atomic(path, out.getvalue(), "video")


def _write_mp4(pictures: Iterator[Array], path: Path, rate: float) -> None:
    import imageio_ffmpeg

    first = next(pictures)
    writable_directory(path.parent, "video")
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".film-") as folder:
        film = Path(folder) / "film.mp4"  # the encoder needs a seekable file
        size = (first.shape[1], first.shape[0])
        options: dict[str, Any] = {"codec": "libx264", "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        encoder = imageio_ffmpeg.write_frames(str(film), size, fps=rate, **options)
        encoder.send(None)
        picture, count = first, 0
        try:
            for picture in chain([first], pictures):
                encoder.send(picture.tobytes())
                count += 1
            for _ in range(round(HOLD * rate)):
                encoder.send(picture.tobytes())
                count += 1
            encoder.close()
            kept = imageio_ffmpeg.count_frames_and_secs(str(film))[0]  # the encoder does not tell that it failed
        except (OSError, RuntimeError):
            kept = 0
        if kept < count:
            raise NotWritable("video", str(path), f"room for a film of {count} frames")
        with film.open("rb") as whole, replacing(path, "video") as file:
            shutil.copyfileobj(whole, file)
