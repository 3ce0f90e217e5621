"""Models, the threat model and its channel, the loop, random numbers, and the registry of components. The nouns are imported from here."""

from tailgate.core.components import (
    Attack,
    Controller,
    Defence,
    Geared,
    Manoeuvre,
    Paced,
    Plant,
    Receiver,
    Recording,
    Sensor,
    Sized,
    View,
    WhiteBox,
)
from tailgate.core.kinds import AIRED, Kind, Mode
from tailgate.core.nouns import (
    Air,
    Array,
    Command,
    Estimate,
    Frame,
    Innovation,
    Lane,
    Model,
    Prior,
    Received,
    Scene,
    no_command,
    pair_of,
    param,
)
from tailgate.core.quantities import Count, Discount, Finite, NonNegative, Positive, PositiveCount, Probability

__all__ = [
    "AIRED", "Air", "Array", "Attack", "Command", "Controller", "Count", "Defence", "Discount", "Estimate", "Finite", "Frame",
    "Geared", "Innovation", "Kind", "Lane", "Manoeuvre", "Mode", "Model", "NonNegative", "Paced", "Plant", "Positive", "PositiveCount",
    "Prior", "Probability", "Received", "Receiver", "Recording", "Scene", "Sensor", "Sized", "View", "WhiteBox",
    "no_command", "pair_of", "param",
]  # fmt: skip
