"""Derivatives by machine code, compared with those of PyTorch."""

import dataclasses

import numpy as np
import pytest

from tailgate.agents.scripts.triggers import Trigger
from tailgate.base.errors import NotApplicable
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.engine.adjoint import Adjoint
from tailgate.engine.tracing import traced
from tailgate.ensemble.search import Arena

torch = pytest.importorskip("torch")
from tailgate.engine.torch_form import TorchForm  # noqa: E402
from tailgate.ensemble.gradient import Pace, gradient, gradient_of  # noqa: E402
from tailgate.ensemble.injection import Injection  # noqa: E402

OPERATIONS = {
    "sum": lambda x, u: x + u - 2.0 * (u - x), "product": lambda x, u: x * u * u, "quotient": lambda x, u: np.where(u == 0.0, x, x / u),
    "least": lambda x, u: np.minimum(x, u) + np.minimum(u, u), "most": lambda x, u: np.maximum(x, u), "size": lambda x, u: np.abs(x - u),
    "root": lambda x, u: np.sqrt(np.abs(u)) + x, "choice": lambda x, u: np.where(u > x, u * x, u - x), "negative": lambda x, u: -u * x,
    "rounded": lambda x, u: np.floor(u) * u + np.rint(x),
}  # fmt: skip
BATCH, STEPS = 9, 4


def by_torch(form, held, arguments, slopes):
    """The slopes by the arguments (K, B, ...), by the torch form."""
    episodes, given = form.start(held), [torch.tensor(one, requires_grad=True) for one in arguments]
    total = sum((torch.as_tensor(episodes.step({"u": one})["y"]) * torch.tensor(slope)).sum() for one, slope in zip(given, slopes, strict=True))
    return np.stack([slope.numpy() for slope in torch.autograd.grad(total, given)])


@pytest.mark.parametrize("name", OPERATIONS)
def test_each_operation_has_the_slope_of_pytorch(name):
    """Whole numbers among the arguments: equal ones, zeros, and signs of both kinds."""
    rng = np.random.default_rng(3)
    held = {"x": rng.integers(-2, 3, BATCH).astype(float), "kept": rng.normal(size=BATCH)}
    arguments, slopes = rng.integers(-2, 3, (STEPS, BATCH, 2)).astype(float), rng.normal(size=(STEPS, BATCH))

    def step(state, given):
        made = OPERATIONS[name](state["x"], given["u"][:, 0]) + 0.5 * given["u"][:, 1] * state["kept"]
        return {"x": 0.5 * made, "kept": state["kept"]}, {"y": made, "sign": made > 0.0}

    trace = traced(step, {key: leaf[:1] for key, leaf in held.items()}, {"u": arguments[0, :1]})
    tape = Adjoint(trace, ("y", "sign"), ("y",)).start(held, STEPS + 3)  # it may end early
    plain = dict(held)
    for given in arguments:
        with np.errstate(all="ignore"):
            plain, wanted = step(plain, {"u": given})
        made = tape.step({"u": given})
        assert all(np.array_equal(made[key], wanted[key]) for key in wanted) and set(made) == set(wanted)
    found, wanted = tape.backwards({"y": slopes})["u"], by_torch(TorchForm(trace, ("y",)), held, arguments, slopes)
    assert np.allclose(found, wanted, rtol=1e-12, atol=1e-14) and wanted.any()


LONG = [("gusty-stop-and-go-v0", "chi2_kf", 60), ("stop-and-go-v0", "safe_state_brake", 30), ("road-string-v0", "kf", 30),
        ("stop-and-go-v0", "imm", 40), ("road-following-v0", "rkf", 50), ("platoon-gusty-v0", "dkf", 40),
        ("platoon-gusty-v0", "chi2_dkf", 12), ("network-restless-v0", "dkf", 12), ("network-restless-weak-v0", "saturated_dkf", 20), ("network-restless-v0", "kf", 6)]  # fmt: skip


@pytest.mark.parametrize(("scenario", "defence", "horizon"), [
    ("gusty-stop-and-go-v0", "chi2_kf", 20), ("lane-keeping-v0", "cusum_reacquire_kf", 20), *(pytest.param(*case, marks=pytest.mark.long) for case in LONG),
])  # fmt: skip
def test_whole_loops_have_the_slopes_of_pytorch(scenario, defence, horizon):
    place, spec = load_scenario(scenario).with_threat(kinds=("fdi",), onset=2, end=None, budget=None), Spec("defence", defence)
    place = dataclasses.replace(place, horizon=horizon)
    loop = place.loop(spec.make(), spec.entry.uses)
    both = [Injection(loop, Trigger(), compiled) for compiled in (True, False)]
    assert [one.compiled for one in both] == [True, False]
    brief = loop.brief
    sent = 0.05 * np.random.default_rng(1).normal(size=(horizon, *brief.granted.shape)) * np.where(brief.granted, np.minimum(brief.bounds, 5.0), 0.0)
    keys = draws.keys("train", range(4))
    for schedule in (sent, np.stack([sent, -sent, 0.5 * sent, 2.0 * sent])):  # one for all, and one for each
        (damage, slope), (same, wanted) = (gradient_of(one, keys, schedule, None) for one in both)
        assert np.array_equal(damage, same) and np.abs(wanted).max() > 0.0
        assert np.max(np.abs(slope - wanted)) <= 1e-9 * np.max(np.abs(wanted))


def test_what_has_no_rule_is_left_to_pytorch():
    place, spec = load_scenario("platoon-gusty-v0").with_threat(kinds=("fdi",)), Spec("defence", "trust_dkf")
    assert not Injection(place.loop(spec.make(), spec.entry.uses), Trigger()).compiled


@pytest.mark.long
def test_several_agents_without_machine_code_are_refused(tmp_path):
    arena = Arena("test", "platoon-gusty-v0", 20, "trust_dkf", {"kinds": ("fdi",), "fdi_bound": 3.0}, None)
    with pytest.raises(NotApplicable, match=r"agents.*5.*PyTorch takes half a minute"):
        gradient(arena, Pace(8, 1, 1, 2), tmp_path, scripts=["fdi:value=3"])
    assert not list(tmp_path.iterdir())
