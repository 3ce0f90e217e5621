"""Bad input of the radar's challenges."""

import pytest

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core.registry import make


@pytest.mark.parametrize("name", ["cra", "pycra", "algorithm2"])
def test_a_plant_without_an_echo_is_refused(name, short):
    """Car following by odometry hears nothing in a challenge."""
    with pytest.raises(NotApplicable, match="echo"):
        short().loop(make("defence", name))


@pytest.mark.parametrize(
    "field, value",
    [
        ("challenge", "sometimes"), ("probability", 1.5), ("probability", -0.1), ("times", [0]), ("watch", 2.0), ("suspicion", 0.0),
        ("false_alarm", 0.0), ("false_alarm", 1.0), ("margin", -1.0), ("quiet", 0), ("mode", "fly"), ("linger", -1.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["cra", "pycra", "algorithm2"])
def test_parameters_out_of_range_are_refused(name, field, value):
    """The error names the defence, the field and the value."""
    with pytest.raises(InputError, match=rf"defence {name}\.{field}"):
        make("defence", name, **{field: value})


@pytest.mark.parametrize("name", ["cra", "pycra", "algorithm2"])
def test_what_would_be_ignored_is_refused(name):
    """A list where challenges are random, a probability where they are fixed, and a challenge before anybody is asked."""
    for field, value, challenge in (("times", (15, 50), "random"), ("probability", 0.3, "fixed"), ("times", (1, 15), "fixed")):
        with pytest.raises(InputError, match=rf"defence {name}\.{field}"):
            make("defence", name, challenge=challenge, **{field: value})
