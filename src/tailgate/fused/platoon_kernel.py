"""What is compiled of a platoon; a single car does without."""

from . import kernel, platoon, platoon_seat, wires
from .compiled import Kernel


@Kernel
def run(places, first_block, last_block, part):
    """`kernel.play`, of a platoon."""
    return kernel.play(
        platoon.start, platoon.advance, wires.obey, platoon.scripted, wires.decode, platoon_seat.pay, platoon_seat.look, places,
        first_block, last_block, part,
    )  # fmt: skip
