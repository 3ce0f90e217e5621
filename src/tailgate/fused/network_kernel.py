"""What is compiled of a network; nobody who drives needs it."""

from . import kernel, network, network_seat, wires
from .compiled import Kernel


@Kernel
def run(places, first_block, last_block, part):
    """`kernel.play`, of a network."""
    return kernel.play(
        network.start, network.advance, wires.obey, network.scripted, wires.decode, network_seat.pay, network_seat.look, places,
        first_block, last_block, part,
    )  # fmt: skip
