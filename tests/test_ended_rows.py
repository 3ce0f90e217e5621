"""Episodes that have ended cost nobody: what a defence returns for them is looked at no more. And numbers that are none."""

import dataclasses

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout


@dataclasses.dataclass(frozen=True)
class Fails:
    """A filter whose score is no number once it reads a smaller gap; under the attack it reads 50 m more than there are."""

    inner: object
    below: float = 42.0
    uses = ("measurements", "v2v")

    def prepare(self, model):
        return self.inner.prepare(model)

    def start(self, plan, prior):
        return self.inner.start(plan, prior)

    def step(self, plan, state, received, known_u, draws):
        state, estimate = self.inner.step(plan, state, received, known_u, draws)
        gap = received.v2v[..., 0] - received.y[..., 0]
        return state, estimate._replace(score=np.where(gap < self.below, np.nan, estimate.score))


@pytest.mark.parametrize("plain", [True, False])
def test_a_failure_after_the_end_costs_no_other_row(plain):
    """Each row is as it is alone, in both engines."""
    place = load_scenario("stop-and-go-v0").with_threat(fdi_bound=50.0, budget=None)
    attack = Spec("attack", "fdi:start_step=60,value=-50,targets=[position]").make()
    loop = place.loop(Fails(make("defence", "kf"), below=200.0), ("measurements", "v2v"))
    seeds = [0, 1, 2]
    late = place.loop(Fails(make("defence", "kf")), ("measurements", "v2v"))
    whole = rollout(late, attack, draws.keys("report", seeds), plain=plain)
    assert len(set(whole.length.tolist())) == 3 and whole.length.max() < late.horizon
    assert np.isnan(whole.score).any()
    alone = [rollout(late, attack, draws.keys("report", [seed]), plain=plain).trace_hash(0) for seed in seeds]
    assert [whole.trace_hash(row) for row in range(3)] == alone
    with pytest.raises(InputError, match="defence output score: got 'NaN or infinity in step"):
        rollout(loop, attack, draws.keys("report", seeds), plain=plain)


@pytest.mark.parametrize(("field", "value"), [
    ("horizon", True), ("horizon", "600"), ("threat_model", {"memory": True}), ("threat_model", {"budget": True}), ("threat_model", {"fdi_bound": True}),
    ("plant", {"name": "car_following", "dt": 0.1, "gap": "85.5"}),
])  # fmt: skip
def test_words_and_truths_are_no_numbers(field, value):
    data = {"name": "odd", "plant": {"name": "car_following", "dt": 0.1}, "sensor": "odometry", "controller": "acc", "manoeuvre": "constant", "horizon": 10}
    with pytest.raises(InputError, match="a number"):
        load_scenario(data | {field: value})


def test_numbers_with_an_exponent_are_numbers(tmp_path):
    """YAML 1.1 takes 1e2 for text."""
    (tmp_path / "odd.yaml").write_text(
        "plant: {name: car_following, dt: 1e-1}\nsensor: odometry\ncontroller: acc\nmanoeuvre: constant\nhorizon: 10\nthreat_model: {kinds: [fdi], fdi_bound: 1e2}\n"
    )
    place = load_scenario(str(tmp_path / "odd.yaml"))
    assert (place.plant.dt, place.threat_model.fdi_bound) == (0.1, 100.0)


@pytest.mark.parametrize(("truth", "words"), [({"plant": {"dt": 0.05}}, "clock"), ({"latency": 10**9}, "10000")])
def test_a_truth_that_makes_no_sense_is_refused(truth, words):
    data = {"name": "odd", "plant": {"name": "car_following", "dt": 0.1}, "sensor": "odometry", "controller": "acc", "manoeuvre": "constant", "horizon": 10}
    with pytest.raises(InputError, match=words):
        load_scenario(data | {"truth": truth}).loop(make("defence", "kf"))
