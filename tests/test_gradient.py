"""The torch form of a loop, its derivatives, and the attack that ascends them."""

import dataclasses
import importlib
import json
import sys

import numpy as np
import pytest

from tailgate.agents.scripts.triggers import Near, Trigger
from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core import Kind, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.ensemble.schedule import Schedule, Scheduled, schedule_of, steps_of
from tailgate.ensemble.search import Arena, Found
from tailgate.play.trace import rollout

torch = pytest.importorskip("torch")
from tailgate.ensemble.gradient import Pace, ascend, gradient, gradient_masking, gradient_of, hindsight, moved, smooth_damage, worthiest  # noqa: E402
from tailgate.ensemble.injection import Course, Injection  # noqa: E402

FDI = {"kinds": ("fdi",), "onset": 2, "end": None, "budget": None}
SMOOTH = {"car": ("stop-and-go-v0", "kf", 40), "platoon": ("platoon-gusty-v0", "dkf", 8)}
LOOPS = {
    "car": ("gusty-stop-and-go-v0", "chi2_kf", 40), "radar": ("radar-braking-v0", "chi2_kf", 30), "network": ("network-restless-v0", "dkf", 8),
    "platoon": ("platoon-gusty-v0", "dkf", 20), "loops": ("network-restless-v0", "lasso_dkf", 4), "blends": ("network-restless-v0", "chi2_dkf", 5),
}  # fmt: skip


def loop_of(scenario, defence, horizon, **threat):
    place = load_scenario(scenario).with_threat(**(FDI | threat))
    place = dataclasses.replace(place, horizon=horizon)
    spec = Spec("defence", defence)
    return place.loop(spec.make(), spec.entry.uses)


def drawn(loop, seed, size=1.0):
    """A random schedule within the bounds, with numbers that a program's text keeps."""
    brief = loop.brief
    values = np.random.default_rng([9, seed]).uniform(-size, size, (steps_of(brief), *brief.granted.shape))
    values = np.round(values * np.minimum(brief.bounds, 10.0), 3) * brief.granted
    return Schedule({"name": "time"}, values, np.random.default_rng([10, seed]).random(len(values)) < 0.6)


def for_each(schedule, episodes):
    """The same schedule in each episode."""
    return Schedule(schedule.trigger, *(np.repeat(part[None], episodes, axis=0) for part in (schedule.values, schedule.chosen)))


def figures(loop, trace):
    """The smallest gap of a follower and the largest error, (K, B)."""
    gap = np.min(np.where(loop.model.followers, trace.signals["gap"], np.inf), axis=2)
    return gap, np.max(loop.model.error(trace.signals["estimate"], trace.signals["truth"]), axis=2)


@pytest.mark.thin(3)
@pytest.mark.parametrize("name", LOOPS)
def test_the_torch_form_has_the_bits_of_the_loop(name):
    """Gaps and errors under a schedule are those of the program that is exported, played by the plain loop."""
    loop = loop_of(*LOOPS[name])
    schedule, keys = drawn(loop, 0), draws.keys("train", range(3))
    path = Injection(loop, Trigger()).play(keys, torch.tensor(schedule.sent, requires_grad=True))
    assert path.error.requires_grad
    trace = rollout(loop, Scheduled(for_each(schedule, 3)), keys, plain=True)
    assert (trace.kind == int(Kind.FDI)).any()
    for got, wanted in zip((path.gap, path.error), figures(loop, trace), strict=True):
        count = min(len(got), len(wanted))
        live = path.live[:count]
        assert np.array_equal(got.detach().numpy()[:count][live], wanted[:count][live])


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", SMOOTH)
def test_derivatives_are_those_of_finite_differences(name):
    """The squares of all errors, by what is injected."""
    loop = loop_of(*SMOOTH[name])
    injection, keys, sent = Injection(loop, Trigger()), draws.keys("train", range(2)), drawn(loop, 1, 0.3).values

    def figure(sent):
        return (injection.play(keys, sent).error ** 2).sum()

    schedule = torch.tensor(sent, requires_grad=True)
    (slope,) = torch.autograd.grad(figure(schedule), schedule)
    slope, step, tried = slope.numpy(), 1e-3, 0
    for place in map(tuple, np.argwhere(np.abs(slope) >= np.sort(np.abs(slope), axis=None)[-8])):

        def difference(step, place=place):
            moved = [sent.copy(), sent.copy()]
            moved[0][place], moved[1][place] = sent[place] + step, sent[place] - step
            up, down = (float(figure(torch.tensor(x))) for x in moved)
            return (up - down) / (2.0 * step)

        wanted = (4.0 * difference(step) - difference(2.0 * step)) / 3.0  # without the error of second order
        assert abs(slope[place] - wanted) <= 1e-6 * abs(wanted), (place, slope[place], wanted)
        tried += wanted != 0.0
    assert tried >= 8


def responses(loop, keys):
    """What a unit of false data in each step does to the error of the estimate in each step, (T, K, n), from the loop itself."""
    steps = steps_of(loop.brief)

    def error(values):
        schedule = Schedule({"name": "time"}, values[None], np.ones((1, steps), bool))
        trace = rollout(loop, Scheduled(schedule), keys, plain=True)
        return (trace.signals["estimate"] - trace.signals["truth"])[:, 0, 0]

    rest, out = error(np.zeros((steps, 1, 1))), []
    for t in range(steps):
        unit = np.zeros((steps, 1, 1))
        unit[t] = 1.0
        out.append(error(unit) - rest)
    return np.array(out)


@pytest.mark.thin(2)
@pytest.mark.parametrize("budget", [None, 6])
def test_a_linear_loop_is_led_to_its_optimum(budget):
    """The farthest error under bounded false data is a linear programme: the bound times the sum of the largest responses along a direction."""
    bound = 80.0
    loop = loop_of("linear-dos-v0", "kf", 30, fdi_bound=bound, onset=6)
    found = responses(loop, draws.keys("train", [0]))
    angle = np.linspace(0.0, np.pi, 2001)
    along = np.abs(np.einsum("tkn,na->tka", found, np.stack([np.cos(angle), np.sin(angle)])))
    best = bound * np.max(np.sum(-np.sort(-along, axis=0)[:budget], axis=0))
    steps = steps_of(loop.brief)
    chosen = np.arange(steps) < (steps if budget is None else budget)
    injection, keys, rng = Injection(loop, Trigger()), draws.keys("tune", range(16)), np.random.default_rng(5)
    ends = []
    for _ in range(4):
        start = Schedule({"name": "time"}, rng.uniform(-0.1 * bound, 0.1 * bound, (steps, 1, 1)), chosen)
        ends.append(ascend(injection, start, budget, 25, keys, None))
    end = max(ends, key=lambda one: float(np.mean(gradient_of(injection, keys, one.sent, None)[0])))
    reached = np.max(np.linalg.norm(np.einsum("t,tkn->kn", end.sent[:, 0, 0], found), axis=1))
    assert np.max(np.abs(end.sent)) <= bound and np.count_nonzero(end.chosen) == (steps if budget is None else budget)
    assert 0.99 * best <= reached <= best * (1.0 + 1e-6)
    assert np.any(np.diff(np.sign(end.sent[end.chosen, 0, 0]))) or budget is not None  # a constant bias is not the optimum


@pytest.mark.long
def test_the_exported_program_plays_the_schedule(tmp_path):
    """With a trigger on the road, a budget, and steps without a value: the file gives the bits of the torch form."""
    loop = loop_of("gusty-stop-and-go-v0", "kf", 160, onset=20)
    schedule = drawn(loop, 3)._replace(trigger={"name": "near", "threshold": 91.0})
    loop = dataclasses.replace(loop, threat=dataclasses.replace(loop.threat, budget=int(schedule.chosen.sum())))
    schedule.write(tmp_path / "found.yaml", loop.brief, "A test.")
    keys = draws.keys("train", range(4))
    path = Injection(loop, Near(threshold=91.0)).play(keys, torch.tensor(schedule.sent, requires_grad=True))
    for plain in (True, False):
        trace = rollout(loop, Spec("attack", str(tmp_path / "found.yaml")).make(), keys, plain=plain)
        used = (trace.kind == int(Kind.FDI)).sum(axis=0)
        assert 0 < used.max() <= schedule.chosen.sum() and not trace.signals["refused"].any()
        for got, wanted in zip((path.gap, path.error), figures(loop, trace), strict=True):
            assert np.array_equal(got.detach().numpy()[path.live], wanted[: len(path.live)][path.live])


@pytest.mark.thin(2)
@pytest.mark.parametrize("text", [
    "fdi:value=-2.5,start_step=30", "fdi:value=2,targets=[velocity],trigger=near,threshold=91,burst=3,pause=4",
    "fdi_ramp:base=0.5,rate=-0.25,limit=3,trigger=closing,threshold=1,length=9", "fdi:value=1,signs=2",
])  # fmt: skip
def test_a_script_as_a_schedule_sends_the_same(text):
    loop, keys = loop_of("gusty-stop-and-go-v0", "kf", 160, onset=20, budget=12), draws.keys("train", range(3))
    script = rollout(loop, Spec("attack", text).make(), keys, plain=True)
    schedule = rollout(loop, Scheduled(for_each(schedule_of(text, loop.brief), 3)), keys, plain=True)
    assert (script.kind != 0).any()
    assert np.array_equal(script.kind, schedule.kind)
    assert np.array_equal(script.signals["value"], schedule.signals["value"])
    with pytest.raises(InputError, match="false data"):
        schedule_of("dos_hold", loop.brief)


def test_a_table_for_each_agent(tmp_path):
    loop = loop_of("platoon-gusty-v0", "dkf", 12, agents=(1, 2))
    schedule = drawn(loop, 4)
    schedule.write(tmp_path / "found.yaml", loop.brief, "A test.")
    trace = rollout(loop, Spec("attack", str(tmp_path / "found.yaml")).make(), draws.keys("train", [0]), plain=True)
    onset = loop.threat.onset - 1
    assert np.array_equal(trace.signals["value"][onset:, 0], schedule.sent[: len(trace.kind) - onset])
    assert np.array_equal(trace.kind[onset:, 0] != 0, schedule.chosen[: len(trace.kind) - onset])
    (tmp_path / "wrong.yaml").write_text("phases: [{kind: fdi, value: {name: table, values: [[1.0, 2.0]]}}]\n")
    with pytest.raises(InputError, match=r"step 1.*one for each of 5 agents"):
        Spec("attack", str(tmp_path / "wrong.yaml")).make().prepare(loop.brief)


@pytest.mark.parametrize("values", ["[]", "[.nan]", "[1e10]", "[[]]", "[a]"])
def test_a_bad_table_is_refused(tmp_path, values):
    (tmp_path / "wrong.yaml").write_text(f"phases: [{{kind: fdi, value: {{name: table, values: {values}}}}}]\n")
    with pytest.raises(InputError, match="values"):
        Spec("attack", str(tmp_path / "wrong.yaml")).make()


def test_the_budget_goes_to_the_worthiest_steps():
    assert worthiest(np.array([0.1, 0.5, 0.5, -1.0]), 2).tolist() == [False, True, True, False]
    assert worthiest(np.zeros((2, 3)), 1).tolist() == [[True, False, False]] * 2
    chosen, worth = np.array([True, True, True, False, False, False]), np.array([3.0, 1.0, 2.0, 9.0, 8.0, 0.0])
    assert moved(chosen, worth, 3, np.array(0.3)).tolist() == [True, False, True, True, False, False]  # one step moves
    assert moved(chosen, worth, 3, np.array(1.0)).tolist() == [True, False, False, True, True, False]
    assert moved(chosen, worth, None, np.array(0.3)).all()


ARENA = Arena("test", "braking-v0", 20, "kf", {"kinds": ("fdi",), "fdi_bound": 3.0}, None)
TINY = Pace(64, 1, 2, 8)


@pytest.mark.long
def test_the_search_is_repeatable_and_its_file_is_an_attack(tmp_path, capsys, monkeypatch):
    told = []
    for name in ("FINAL", "COMPARED"):
        monkeypatch.setattr(f"tailgate.ensemble.gradient.{name}", 32)
    found = [gradient(ARENA, TINY, tmp_path / name, 3, lambda *one: told.append(one)) for name in ("a", "b")]
    assert [one._replace(attack="") for one in found[0]] == [one._replace(attack="") for one in found[1]]
    files = [next((tmp_path / name).glob("*.yaml")) for name in ("a", "b")]
    assert files[0].read_bytes() == files[1].read_bytes() and f"program:path={files[0]}" == found[0][0].attack
    assert [(n, of) for n, of, *_ in told[:2]] == [(1, 2), (2, 2)]
    rows = tmp_path / "rows.jsonl"
    command = ["evaluate", "--scenario", "braking-v0", "--threat", "kinds=[fdi]", "--threat", "fdi_bound=3.0", "--threat", "budget=20"]
    assert main([*command, "--defence", "kf", "--attack", found[0][0].attack, "--seeds", "2", "--out", str(rows)]) == 0
    played = [json.loads(line) for line in rows.read_text().splitlines()]
    assert len(played) == 2 and all(row["status"] == "ok" and row["attack_steps"] > 0 for row in played), capsys.readouterr()


def test_the_smooth_damage_follows_the_damage():
    """A collision counts much and a near miss little, where somebody drives; else an error beyond the bound."""
    rows = torch.tensor([[9.0, 5.0, 1.0, -1.0], [8.0, 6.0, 2.0, -2.0]], dtype=torch.float64)
    course = Course(rows, 10.0 - rows, np.array([[True] * 4, [True, True, True, False]]))
    by_gap = smooth_damage(course, True, None).numpy()
    assert np.all(np.diff(by_gap) > 0.0) and by_gap[3] > 0.85 and by_gap[2] < 0.15  # -1 m before it ended, 1 m
    by_error = smooth_damage(course, False, 10.0).numpy()
    assert np.all(np.diff(by_error) > 0.0) and by_error[3] > 0.7 and by_error[0] < 0.01
    assert np.allclose(smooth_damage(course, False, None).numpy(), [2.0, 5.0, 9.0, 11.0], atol=0.2)  # the largest errors


def test_episodes_side_by_side_change_no_derivative(monkeypatch):
    loop = loop_of(*LOOPS["car"])
    injection, keys, schedule = Injection(loop, Trigger()), draws.keys("train", range(5)), drawn(loop, 6)
    together = [gradient_of(injection, keys, sent, None) for sent in (schedule.sent, for_each(schedule, 5).sent)]
    monkeypatch.setattr("tailgate.ensemble.gradient.ROOM", 2.5 * 8 * injection.numbers * loop.horizon)
    apart = [gradient_of(injection, keys, sent, None) for sent in (schedule.sent, for_each(schedule, 5).sent)]
    for one, two in zip(together, apart, strict=True):
        assert np.array_equal(one[0], two[0]) and np.allclose(one[1], two[1], rtol=1e-12, atol=1e-15)
    assert np.allclose(together[0][1], together[1][1].sum(axis=0), rtol=1e-9, atol=1e-15) and together[0][1].any()


def test_a_pace_without_rounds_is_refused():
    with pytest.raises(InputError, match=r"pace.rounds.*at least 1"):
        Pace(64, 1, 0, 8)


def test_no_false_data_no_schedule(tmp_path):
    assert gradient(dataclasses.replace(ARENA, threat={"kinds": ("dos_hold",)}), TINY, tmp_path) == []


@pytest.mark.long
def test_hindsight_is_no_less_than_the_schedule_itself():
    loop = ARENA.loop
    values = np.full((steps_of(loop.brief), *loop.brief.granted.shape), -3.0) * loop.brief.granted
    start = Schedule({"name": "near", "threshold": 8.5}, values, np.arange(len(values)) < 20)
    keys = draws.keys("train", range(12))
    hit = np.mean(rollout(loop, Scheduled(for_each(start, 12)), keys, plain=True).signals["collided"].any(axis=0))
    assert 0.0 < hit <= hindsight(ARENA, start, 12, 2, "train")


def test_gradient_masking_is_a_white_box_that_does_less():
    weak, strong = Found("a", 0.1, 0.1, 512), Found("b", 0.2, 0.2, 512)
    assert gradient_masking(weak, strong) and gradient_masking(None, strong)
    assert not gradient_masking(strong, weak) and not gradient_masking(weak, None)


def test_without_torch_one_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "tailgate.engine.torch_form")
    with pytest.raises(ImportError, match=r"tailgate\[train\]"):
        importlib.import_module("tailgate.engine.torch_form")
