"""What is compiled of a car with a radar; car following does without."""

from . import kernel, radar
from .compiled import Kernel


@Kernel
def run(places, first_block, last_block, part):
    """`kernel.play`, of a car with a radar."""
    return kernel.play(radar.start, radar.advance, radar.decide, radar.look, places, first_block, last_block, part)
