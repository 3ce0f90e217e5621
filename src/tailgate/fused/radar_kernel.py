"""What is compiled of a car with a radar; car following does without."""

from . import kernel, radar
from .compiled import compiled


@compiled
def run(floats, whole, words, columns, record, seen, first_block, last_block):
    """`kernel.play`, of a car with a radar."""
    return kernel.play(
        radar.start, radar.advance, radar.decide, radar.look, floats, whole, words, columns, record, seen, first_block, last_block
    )
