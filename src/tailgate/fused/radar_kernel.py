"""What is compiled of a car with a radar; car following does without."""

from . import kernel, radar, seat
from .compiled import Kernel


@Kernel
def run(places, first_block, last_block, part):
    """`kernel.play`, of a car with a radar."""
    return kernel.play(
        radar.start, radar.advance, kernel.obey, radar.decide, seat.decode, seat.pay, radar.look, places, first_block, last_block, part
    )  # fmt: skip
