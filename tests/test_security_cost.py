"""Timing and security: response times against a schedule played out, refused loads, control cost, the choice of messages, sealed wires."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
import yaml

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout
from tailgate.studies import timing_budget
from tailgate.studies.timing_budget import Cost, at_period, choices, control_cost, load_budget, responses, timing, utilisation

from .engines import trace_as_plain

V2V = "platoon-v2v-v0"
FIELDS = ("predecessor_acceleration", "leader_acceleration", "predecessor_command")
TEXT = {
    "scenario": "gusty-stop-and-go-v0", "defence": "kf", "seeds": 8,
    "tasks": [{"name": "one", "period": 4, "wcet": 1}, {"name": "two", "period": 6, "wcet": 2}, {"name": "three", "period": 12, "wcet": 3}],
    "messages": [{"name": "leader_position", "bits": 100, "sender": "one", "receiver": "two"},
                 {"name": "leader_velocity", "bits": 100, "sender": "three", "receiver": "three", "weight": 2}],
    "slot": {"cycle": 0.5, "bits": 120}, "authentication": {"fixed": 0.0, "each_bit": 0.01, "tag": 40, "key_interval": 0.25}, "path": ["two", "three"],
}  # fmt: skip


def system(folder, **changes):
    path = folder / "system.yaml"
    path.write_text(yaml.safe_dump(TEXT | changes))
    return load_budget(str(path))


def test_the_known_answer():
    tasks = [(1, 4), (2, 6), (3, 12)]
    assert responses(tasks) == [1, 3, 10] and utilisation(tasks) == pytest.approx(5 / 6)
    more = [(C + 1, T) for C, T in tasks]
    assert utilisation(more) == pytest.approx(4 / 3) and None in responses(more)


def played(tasks):
    """The response times of the first jobs when all begin together, by playing the schedule in whole steps."""
    left, out, done = [C for C, _ in tasks], [None] * len(tasks), 0
    horizon = max(T for _, T in tasks)
    queue = list(left)
    for t in range(horizon + 1):
        if t:
            for i, (C, T) in enumerate(tasks):
                if t % T == 0:
                    queue[i] += C
        run = next((i for i, work in enumerate(queue) if work > 0), None)
        if run is not None:
            queue[run] -= 1
            left[run] -= 1
            if left[run] == 0 and out[run] is None:
                out[run] = t + 1
                done += 1
    return [R if R is not None and R <= T else None for R, (_, T) in zip(out, tasks, strict=True)]


def test_response_times_are_those_of_a_schedule():
    """300 random task sets, loads from a third to far above one; sets that miss are among them."""
    rng, missed = np.random.default_rng(0), 0
    for _ in range(300):
        tasks = sorted(((int(rng.integers(1, 5)), int(rng.integers(4, 30))) for _ in range(int(rng.integers(1, 6)))), key=lambda task: task[1])
        found, wanted = responses(tasks), played(tasks)
        first = next((i for i, R in enumerate(wanted) if R is None), len(tasks))  # behind a task that is late, its first job says nothing
        assert found[:first] == wanted[:first] and (first == len(tasks) or found[first] is None)
        missed += first < len(tasks)
    assert 20 < missed < 250


def test_times_of_a_system(tmp_path):
    budget = system(tmp_path)
    plain, both = timing(budget, frozenset()), timing(budget, frozenset({"leader_position", "leader_velocity"}))
    assert plain.responses == {"one": 1, "two": 3, "three": 10} and plain.schedulable
    assert plain.delay == pytest.approx(max(1 + 0.5, 10 + 0.5) + (6 + 3) + (12 + 10))
    assert not both.schedulable and both.load == {"control": pytest.approx(2 / 4 + 3 / 6 + 5 / 12)} and both.delay is None
    one = timing(budget, frozenset({"leader_position"}))  # one and two take a second more: R = 2, 5 and more than 12
    assert one.load["control"] == pytest.approx(2 / 4 + 3 / 6 + 3 / 12) and not one.schedulable
    fast = dataclasses.replace(budget, authentication=dataclasses.replace(budget.authentication, each_bit=1e-4))
    held = timing(fast, frozenset({"leader_position"}))
    sent = (held.responses["one"] or 0) + 2 * 0.5 + 0.25  # 140 bits take two slots, and the key comes later
    assert held.delay == pytest.approx(max(sent, held.responses["three"] + 0.5) + 6 + held.responses["two"] + 12 + held.responses["three"])
    assert held.responses["one"] == pytest.approx(1.01)


def test_a_unit_of_its_own_is_not_in_the_way(tmp_path):
    tasks = [task | {"ecu": task["name"]} for task in TEXT["tasks"]]
    held = timing(system(tmp_path, tasks=tasks), frozenset())
    assert held.responses == {"one": 1, "two": 2, "three": 3} and set(held.load) == {"one", "two", "three"}


@pytest.mark.thin(4)
@pytest.mark.parametrize(("metric", "delay"), [("min_gap", 0.0), ("min_gap", 0.4), ("min_gap", 0.8), ("rmse_position", 0.0)])
def test_a_longer_period_never_lowers_the_cost_of_car_following_at_the_same_delay(tmp_path, delay, metric):
    """Not so of errors of late readings, nor of a platoon: docs/security-cost.md."""
    budget = dataclasses.replace(system(tmp_path), metric=metric, seeds=100)
    found = [timing_budget.value_of(budget, control_cost(budget, h, round(delay / h))) for h in (0.1, 0.2, 0.4)]
    assert found == sorted(found)


def test_a_period_keeps_the_seconds_and_the_noise_of_a_second():
    place = load_scenario("gusty-stop-and-go-v0")
    other = at_period(place, 0.2, 3)
    assert other.plant.dt * other.horizon == pytest.approx(place.plant.dt * place.horizon) and other.truth == {"latency": 3}
    assert np.allclose(np.array(other.plant.process_var) / np.array(place.plant.process_var), 2.0)
    assert at_period(place, 0.1, 0).plant == place.plant


def test_the_best_set_is_the_best_of_all(tmp_path, monkeypatch):
    """By a control cost that grows with delay: of enough level, schedulable, and none cheaper."""
    monkeypatch.setattr(timing_budget, "control_cost", lambda budget, h, steps: Cost(h, steps, 10.0 - h * steps, 1.0 + h * steps, 0.0))
    budget = dataclasses.replace(load_budget("platoon-v2v"), periods=(0.1, 0.15, 0.2, 0.3))
    weight = {message.name: message.weight for message in budget.messages}
    for level in (0.0, 1.0, 2.0, 3.0, 4.0):
        report = choices(dataclasses.replace(budget, level=level))
        tried = []
        for h, size in itertools.product(budget.periods, range(4)):
            for some in itertools.combinations(FIELDS, size):
                held = timing(budget, frozenset(some), h)
                if held.delay is not None and sum(weight[name] for name in some) >= level:
                    tried.append(-(10.0 - h * math.ceil(held.delay / h - 1e-9)))
        assert report["best"]["J"] == pytest.approx(min(tried)) and report["best"]["level"] >= level and report["best"]["schedulable"]
        assert len(report["sets"]) == 32 and report["threat"]["authenticated"] == report["best"]["authenticated"]
    assert any(not row["schedulable"] for row in report["sets"])


def test_a_set_that_collides_or_is_too_late_is_no_candidate(monkeypatch):
    """Whatever its gap: at the longer period each set has the better figure and one collision in a hundred."""
    monkeypatch.setattr(timing_budget, "control_cost", lambda budget, h, steps: Cost(h, steps, 10.0 + h, 1.0, 0.01 if h > 0.15 else 0.0))
    report = choices(load_budget("platoon-v2v"))
    assert report["best"]["period"] == 0.1 and report["best"]["why"] is None
    assert {row["why"] for row in report["sets"] if row["period"] == 0.2} == {"collides"}
    assert choices(dataclasses.replace(load_budget("platoon-v2v"), level=4.0))["best"] is None
    slow = dataclasses.replace(load_budget("platoon-v2v"), slot=timing_budget.Slot(50.0, 512))
    monkeypatch.setattr(timing_budget, "control_cost", lambda *_: pytest.fail("a delay beyond the episode is played"))
    report = choices(slow)
    assert report["best"] is None and {row["why"] for row in report["sets"]} == {"too late to be measured", "misses a deadline"}


def test_a_loop_in_which_all_collide_is_not_recommended():
    """Played: three seconds of delay."""
    budget = load_budget("platoon-v2v")
    late = dataclasses.replace(budget, seeds=4, periods=(0.2,), level=0.0, messages=budget.messages[:1], slot=timing_budget.Slot(3.0, 512))
    report = choices(late)
    assert report["best"] is None and all(row["cost"]["crashed"] == 1.0 and row["why"] == "collides" for row in report["sets"])


def played_in(attack, defence="kf", scenario=V2V, **threat):
    guard = Spec("defence", defence)
    place = dataclasses.replace(load_scenario(scenario), horizon=75).with_threat(**threat)
    return rollout(place.loop(guard.make(), guard.entry.uses), Spec("attack", attack).make(), draws.keys("report", range(12)))


def same(one, two):
    return np.array_equal(one.length, two.length) and all(
        np.array_equal(one.signals[name], two.signals[name], equal_nan=True) for name in one.signals if name != "refused"
    )


@pytest.mark.long
@pytest.mark.parametrize(
    "attack",
    ["fdi:value=10,targets=[predecessor_acceleration]", "fdi:value=-10", "fdi_ramp:rate=0.5,limit=10,targets=[]", "dos_jam:low=5,high=5",
     "fdi:value=3,targets=[leader_acceleration,predecessor_command]", "delay:age=5", "replay:window=20"],
)  # fmt: skip
@pytest.mark.parametrize("defence", ["kf", "dkf"])
def test_with_all_messages_authenticated_every_forged_cell_is_the_clean_one(attack, defence):
    clean, open_, sealed = played_in("none", defence), played_in(attack, defence), played_in(attack, defence, authenticated=FIELDS)
    assert same(sealed, clean) and sealed.refused.any() and not (sealed.kind != 0).any()
    assert not same(open_, clean)


@pytest.mark.thin(2)
@pytest.mark.parametrize("attack", ["dos_hold:start_step=60", "dropout:start_step=60"])
def test_a_tag_does_not_keep_a_message_from_being_lost(attack):
    sealed = played_in(attack, authenticated=FIELDS)
    assert same(sealed, played_in(attack)) and (sealed.kind != 0).any() and not sealed.refused.any()


@pytest.mark.long
def test_an_old_value_is_accepted_until_its_key_is_known():
    for age, kept in ((3, True), (4, False)):
        trace = played_in(f"delay:age={age}", authenticated=FIELDS, key_interval=3)
        assert (trace.kind != 0).any() == kept
    assert same(played_in("delay:age=3", authenticated=FIELDS, key_interval=3), played_in("delay:age=3"))


def test_a_replay_is_too_old_after_its_first_round():
    """Its window comes again and again, so that the age of what arrives grows."""
    trace = played_in("replay:window=3,start_step=60", authenticated=FIELDS, key_interval=3)
    hit = (trace.kind != 0).sum(axis=0)
    assert (hit > 0).all() and trace.refused.any() and (trace.kind[np.argmax(trace.kind != 0, axis=0)[0]][0] != 0)
    rounds = [int(np.diff(np.flatnonzero(np.diff(np.concatenate([[0], column != 0, [0]]).astype(int))))[0]) for column in trace.kind.T]
    assert set(rounds) == {3}


def test_other_wires_stay_open():
    attack = "fdi:value=10,targets=[leader_acceleration]"
    assert same(played_in(attack, authenticated=["predecessor_command"]), played_in(attack))
    with pytest.raises(InputError, match=r"authenticated.*'leader'.*leader_acceleration"):
        played_in(attack, authenticated=["leader"])


@pytest.mark.long
@pytest.mark.parametrize("attack", ["delay:age=2", "fdi:value=4", "dos_hold"])
def test_the_compiled_loop_seals_as_the_plain_one_does(attack):
    from .engines import loop_of

    trace_as_plain(*loop_of("platoon-v2v-v0", "kf", attack, horizon=80, authenticated=["predecessor_command"], key_interval=2))


def test_a_threat_model_without_tags_leaves_no_mark():
    assert load_scenario(V2V).config_hash == load_scenario(V2V).with_threat(authenticated=[], key_interval=0).config_hash
    assert load_scenario(V2V).config_hash != load_scenario(V2V).with_threat(authenticated=["predecessor_command"]).config_hash


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tasks": []}, r"tasks: got \[\].*at least one"), ({"path": ["four"]}, "path.*'four'.*three"), ({"path": []}, "path.*from the arrival"), ({"path": ["two", "two"]}, r"path.*\['two', 'two'\].*each task once"),
        ({"periods": [100.0]}, r"periods.*100.*0.003 to 6 s.*60 s"), ({"periods": [1e-6]}, r"periods.*1e-06.*0.003"), ({"periods": [0.1] * 17}, "periods.*17.*16"),
        ({"tasks": [*TEXT["tasks"][:2], {"name": "three", "period": 1e6, "wcet": 3}]}, r"period.*1000000.*10000 times"),
        ({"messages": [TEXT["messages"][0] | {"sender": "x"}]}, "leader_position.sender.*'x'"),
        ({"messages": [TEXT["messages"][0] | {"name": "radar"}]}, "message.*'radar'.*leader_position"),
        ({"messages": TEXT["messages"][:1] * 2}, "no two are equal"), ({"level": 9}, r"level.*9.*\(3\)"),
        ({"slot": {"cycle": 0}}, "slot.cycle"), ({"more": 1}, "more"), ({"messages": [TEXT["messages"][0]] * 15}, "no two"),
    ],
)  # fmt: skip
def test_a_file_that_does_not_fit_is_refused(tmp_path, change, words):
    with pytest.raises(InputError, match=words):
        system(tmp_path, **change)


def test_the_command(tmp_path, capsys):
    tasks = [task | {"period": task["period"] / 100, "wcet": task["wcet"] / 100} for task in TEXT["tasks"]]
    slot, tag = {"cycle": 0.01, "bits": 120}, {"fixed": 0.0, "each_bit": 1e-5, "tag": 10, "key_interval": 0.2}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(TEXT | {"tasks": tasks, "slot": slot, "authentication": tag, "periods": [0.2], "level": 1}))
    path = str(tmp_path / "a.yaml")
    assert cli.main(["cost", "--security", path, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["format"] == "tailgate-security-cost-1" and len(report["sets"]) == 4 and report["best"]["level"] >= 1
    assert report["threat"]["key_interval"] == 1
    assert cli.main(["cost", "--security", path]) == 0 and "best of level 1" in capsys.readouterr().out
    assert cli.main(["cost", "--security", path, "--level", "7"]) == 2 and "--level" in capsys.readouterr().err
    assert cli.main(["cost", "--security", "nothing"]) == 2 and "platoon-v2v" in capsys.readouterr().err
