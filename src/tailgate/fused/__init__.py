"""The fused engine: a loop whose parts have lanes, compiled into one function (docs/speed.md).

A lane is a scalar formula on rows of episodes. What it computes is equal to the plain loop's to the last bit; `fuse` says whether a loop
can be played so, and why if not.
"""

from .build import Constants as Constants
from .build import Refused as Refused
from .build import fuse as fuse
