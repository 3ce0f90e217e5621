"""The traced engine plays environments as the plain loop does, to the last bit, restarts, resets and what was held included."""

import pytest

from .fused import as_plain
from .test_fused import ENVIRONMENTS

MORE = [  # what the fused engine does not play
    {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf", "action": "mode", "interval": 3,
     "threat": {"kinds": ["delay", "replay", "dropout", "dos_hold_fresh"], "memory": 12}},
    {"scenario": "car-following-lossy-v0", "defence": "kf"},
    {"scenario": "stop-and-go-v0", "defence": "kf", "threat": {"hold_from_onset": True, "kinds": ["dos_hold"]}},
    {"scenario": "stop-and-go-v0", "defence": "chi2_kf_sparse"},
    {"scenario": "stop-and-go-v0", "defence": "chi2_kf", "knowledge": "white", "reward": "error"},
]  # fmt: skip


@pytest.mark.parametrize("arguments", [*ENVIRONMENTS, *MORE], ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, tmp_path):
    as_plain(arguments, 5, tmp_path, "traced")
