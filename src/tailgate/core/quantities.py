"""Types of parameters, by what they measure. A value outside is refused where a component is built, by the field's name.

The widest limits, 1e30, keep products of several parameters finite; those of lengths, times and speeds are far outside of any road.
"""

from typing import Annotated

from pydantic import Field, GetPydanticSchema
from pydantic_core import core_schema

from tailgate.base.errors import InputError

Finite = Annotated[float, Field(ge=-1e30, le=1e30, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e30, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e30, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Discount = Annotated[float, Field(gt=0, le=1)]
Count = Annotated[int, Field(ge=0, le=10**9)]
PositiveCount = Annotated[int, Field(ge=1, le=10**9)]
Horizon = Annotated[int, Field(ge=1, le=10**6)]  # steps of an episode
Settling = Annotated[int, Field(ge=0, le=100_000)]  # steps that are played when a plan is made
Latency = Annotated[int, Field(ge=0, le=10_000)]  # steps that a link keeps
Size = Annotated[int, Field(ge=1, le=1000)]  # how many agents, states or sensors: matrices are as large

Step = Annotated[float, Field(ge=1e-4, le=100.0, allow_inf_nan=False)]  # dt [s]
Lag = Annotated[float, Field(ge=1e-3, le=1e4, allow_inf_nan=False)]  # time constant [s]
Headway = Annotated[float, Field(ge=1e-3, le=60.0, allow_inf_nan=False)]  # time headway [s]
Time = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]  # [s]
Position = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]  # [m]
Length = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]  # [m]
Gap = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]  # [m]: at 0 two cars touch
Speed = Annotated[float, Field(ge=0, le=100.0, allow_inf_nan=False)]  # [m/s]
PositiveSpeed = Annotated[float, Field(ge=1e-3, le=100.0, allow_inf_nan=False)]  # [m/s]: 360 km/h; above is another unit
Accel = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]  # [m/s^2]
Rate = Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)]  # size of an acceleration or deceleration [m/s^2]
Gain = Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)]
PositiveGain = Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)]
Spread = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]  # a standard deviation
PositiveSpread = Annotated[float, Field(ge=1e-9, le=1e6, allow_inf_nan=False)]
Variance = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]
PositiveVariance = Annotated[float, Field(ge=1e-18, le=1e12, allow_inf_nan=False)]
Bound = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]  # of what attackers add, radiate or delay [unit of the wire]
Bounded = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]  # what a jammer may leave at a receiver [unit of the wire]
Decibel = Annotated[float, Field(ge=-200.0, le=200.0, allow_inf_nan=False)]

TimeSpan = Annotated[tuple[Time, Time], Field(min_length=2, max_length=2)]

Unchecked = GetPydanticSchema(lambda kind, handler: core_schema.any_schema())  # a component: it was checked when it was built


def check_order(field: str, pair: tuple[float | None, float | None] | None, strict: bool = False) -> None:
    """Raise InputError where the first of two numbers is above the second, or with `strict` equal to it; none: no limit."""
    if pair is None or pair[0] is None or pair[1] is None:
        return
    if pair[0] > pair[1] or (strict and pair[0] == pair[1]):
        raise InputError(field, pair, "two different numbers, the smaller first" if strict else "two numbers, the smaller first")
