"""The game of two: PettingZoo's own tests, what each player sees and is paid, and knobs that change no bit until they are turned."""

import ast
import json
import re
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import tailgate
from tailgate.agents.learners.selfplay import constant, export, play
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind, Mode
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.duel import Attacker, DefenderEnv, Duel
from tailgate.estimators import Steered, SteeredChallenge, compose
from tailgate.estimators.challenge.steered import load_defender
from tailgate.estimators.challenge.steering import Hand, Knob, Menu, nearest, settings
from tailgate.estimators.distributed.distributed_kalman import TailChiSquare
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.estimators.mitigations.responses import Widen
from tailgate.play.trace import rollout

GUSTY = {"scenario": "gusty-stop-and-go-v0", "interval": 20}


def played(place, text, attack, seeds, **options):
    spec = Spec("defence", text) if isinstance(text, str) else None
    made, uses = (spec.make(), spec.entry.uses) if spec else (text, text.uses)
    return rollout(place.loop(made, uses), tailgate.make_attack(attack, **options), keys("train", list(seeds)))


@pytest.mark.parametrize("game, cycles", [
    ({"scenario": "thesis-ch5-v0", "defence": "chi2_dkf:eta=22.8", "interval": 10, "reward": "error"}, 6),
    (GUSTY | {"interval": 100}, 10), (GUSTY | {"interval": 100, "defender_action": "box"}, 3),  # six decisions are an episode
    ({"scenario": "platoon-braking-v0", "defence": "chi2_dkf:eta=22.8", "interval": 110}, 6),
    ({"scenario": "radar-following-v0", "defence": "cra", "interval": 40}, 8),
], ids=["network", "car", "box", "platoon", "challenge"])  # fmt: skip
@pytest.mark.thin(6)
def test_pettingzoo_is_content(game, cycles):
    """parallel_api_test and parallel_seed_test pass without a warning, over the end of an episode and on every kind of system."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(tailgate.parallel_env(**game), num_cycles=cycles)
        parallel_seed_test(lambda: tailgate.parallel_env(**game), num_cycles=cycles)


@pytest.mark.long
@pytest.mark.parametrize("place, plain, steered", [
    ("stop-and-go-v0", "chi2_kf", "steered"), ("stop-and-go-v0", "brake_kf:eta=9", "steered:defence=brake_kf,defence.eta=9"),
    ("stop-and-go-v0", "cusum_kf", "steered:defence=cusum_kf"), ("stop-and-go-v0", "mewma_kf", "steered:defence=mewma_kf"),
    ("stop-and-go-v0", "windowed_chi2_kf", "steered:defence=windowed_chi2_kf"), ("radar-following-v0", "cra", "steered_cra"),
    ("platoon-braking-v0", "chi2_dkf:eta=22.8", "steered:defence=chi2_dkf,defence.eta=22.8"),
])  # fmt: skip
def test_knobs_that_nobody_turns_change_no_bit(place, plain, steered, short):
    """A steered defence at its own values gives the trace of the plain one, and at another setting another trace."""
    scene = short(place, horizon=120)
    own, held = (played(scene, text, "fdi_gaussian", range(4)) for text in (plain, steered))
    assert [own.trace_hash(i) for i in range(4)] == [held.trace_hash(i) for i in range(4)]
    other = played(scene, f"{steered}{',' if '=' in steered else ':'}setting=1", "fdi_gaussian", range(4))
    assert [own.trace_hash(i) for i in range(4)] != [other.trace_hash(i) for i in range(4)]


@pytest.mark.long
def test_a_setting_is_the_defence_with_these_parameters(short):
    """Threshold 8 and braking, held throughout, is brake_kf with eta 8 to the last bit; the menu's last knob runs fastest."""
    knobs = Steered().hand.knobs
    menu = settings(knobs)
    assert [knob.name for knob in knobs] == ["threshold", "mode"] and menu.shape == (15, 2)
    number = int(np.flatnonzero((menu == [8.0, Mode.BRAKE]).all(axis=1))[0])
    assert number == 1 * 3 + 2 and nearest(knobs) == 3 * 3  # eta 20, normal
    place = short("gusty-stop-and-go-v0", horizon=100)
    one, two = (played(place, text, "fdi_gaussian", range(4)) for text in (f"steered:setting={number}", "brake_kf:eta=8"))
    assert [one.trace_hash(i) for i in range(4)] == [two.trace_hash(i) for i in range(4)] and (one.mode == Mode.BRAKE).any()


@pytest.mark.long
def test_the_challenge_knob_sets_how_often_the_probe_is_muted(short):
    """Over 8000 steps without an attack the muted share is the knob's probability within its 99.9 % interval."""
    place = short("radar-following-v0", horizon=80)
    for number, chance in ((0, 0.02), (6, 0.3)):
        trace = played(place, f"steered_cra:setting={number}", "none", range(100))
        muted, n = np.count_nonzero(~trace.probe), trace.probe.size
        assert abs(muted / n - chance) < 3.29 * np.sqrt(chance * (1 - chance) / n)


def test_what_a_game_would_ignore_is_refused():
    with pytest.raises(InputError, match=r"menu\.interval"):
        Duel.make(**GUSTY, menu={"interval": 5})
    with pytest.raises(InputError, match=r"menu: .* expected none"):
        Duel.make(**GUSTY | {"defence": Steered(defence="chi2_kf")}, menu={"thresholds": [6, 9]})


def test_the_cost_of_care_is_that_of_safety_whatever_the_payoff():
    costs = {}
    for payoff in ("safety", "zero_sum"):
        duel = Duel.make(**GUSTY, payoff=payoff)
        costs[payoff] = play(duel, tailgate.make_attack("none"), keys("train", range(8)), lambda seen: np.full(len(seen), 2)).cost
    assert (costs["safety"] == costs["zero_sum"]).all() and (costs["safety"] > 0.0).all()


@pytest.mark.long
def test_rows_are_steered_on_their_own():
    """Each row obeys its own knobs: a batch with three settings equals three batches with one."""
    duel = Duel.make(**GUSTY)
    chosen, attack = np.array([2, 7, 14]), tailgate.make_attack("fdi_gaussian", start_step=60)

    def run(rows):
        held = keys("train", [5 + i for i in rows])
        state, rival = duel.begin(held), Attacker(attack, duel.seat, held)
        for _ in range(6):
            state, _, paid, _ = duel.step(state, rival, chosen[rows], state.loop.ended)
        return paid, duel.defender_sees(state), state.loop.estimate.x

    whole = run([0, 1, 2])
    for i in range(3):
        for together, alone in zip(whole, run([i]), strict=True):
            np.testing.assert_array_equal(together[i], alone[0])
    assert len({float(score) for score in whole[1][:, -2]}) == 3  # where the threshold stands


@pytest.mark.long
@pytest.mark.parametrize("interval", [1, 7, 20])
def test_masks_agree_with_what_the_channel_accepts(interval):
    """In random play no allowed action is refused throughout, and every other one than none is where its mask is 0."""
    threat = {"budget": 25, "duration": 6, "cooldown": 4, "onset": 20, "end": 200}
    env = tailgate.parallel_env(scenario="gusty-stop-and-go-v0", interval=interval, threat=threat)
    rng, accepted, refused = np.random.default_rng(0), 0, 0
    for seed in range(2):
        _, info = env.reset(seed=seed)
        while env.agents:
            used, mask = int(env.game.loop.channel.used[0]), info["attacker"]["action_mask"]
            action = int(rng.integers(len(mask)))
            _, _, _, _, info = env.step({"attacker": action, "defender": int(rng.integers(15))})
            assert info["attacker"]["illegal"] == (mask[action] == 0)
            cost = int(env.game.loop.channel.used[0]) - used
            assert (cost > 0) == bool(mask[action] and action)
            accepted, refused = accepted + cost, refused + (not mask[action])
    assert accepted == 2 * 25 and refused > 10


def test_the_defender_sees_the_attack_only_through_what_arrives():
    """An injection of nothing is an attack, and the defender sees every bit as without; a real one it sees after the same step."""
    duel = Duel.make(**GUSTY, threat={"onset": 30})
    seen = {}
    for value in (None, 0.0, -4.0):
        held = keys("train", range(8))
        attack = tailgate.make_attack("none") if value is None else tailgate.make_attack("fdi", start_step=50, value=value)
        state, rival = duel.begin(held), Attacker(attack, duel.seat, held)
        seen[value] = []
        for _ in range(6):
            state, _, _, frame = duel.step(state, rival, np.full(8, 9), state.loop.ended)
            seen[value].append(duel.defender_sees(state))
        assert (frame.command.kind != Kind.NONE).all() == (value is not None)
    np.testing.assert_array_equal(seen[0.0], seen[None])
    np.testing.assert_array_equal(seen[-4.0][:2], seen[None][:2])
    assert (np.array(seen[-4.0][3:]) != np.array(seen[None][3:])).any(axis=(0, 2)).all()


def test_what_the_defender_sees_is_what_it_has():
    """Believed gap, speed and residuals are those of its own estimate and of the message; none of them is the truth."""
    duel = Duel.make(scenario="gusty-stop-and-go-v0", interval=1)
    names = duel.plan.sight.names
    held = keys("train", range(5))
    state, rival = duel.begin(held), Attacker(tailgate.make_attack("fdi", start_step=50, value=3.0), duel.seat, held)
    for _ in range(70):
        before = state
        state, _, _, frame = duel.step(state, rival, None, state.loop.ended)
    seen = dict(zip(names, duel.defender_sees(state).T.astype(float), strict=True))
    x, message = frame.estimate.x[:, 0], before.loop.sent[:, 0, 2:4]
    np.testing.assert_allclose(seen["gap"] * 50.0, message[:, 0] - x[:, 0], rtol=1e-6)
    np.testing.assert_allclose(seen["closing"] * 5.0, x[:, 1] - message[:, 1], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(seen["residual_position"], frame.received.y[:, 0, 0] - x[:, 0], rtol=1e-5, atol=1e-5)  # noise of 1 m
    np.testing.assert_allclose(seen["score"], np.log1p(frame.estimate.score[:, 0]), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(seen["alarm"], frame.estimate.alarm[:, 0])
    assert (np.abs(seen["gap"] * 50.0 - (message[:, 0] - frame.truth[:, 0, 0])) > 1e-3).all()
    assert set(duel.told(state)) == {"step", "threshold", "mode"}


@pytest.mark.long
def test_payoffs():
    """zero_sum is minus the attacker's reward; safety is the costs of care by hand, and -1 at a collision."""
    attack = {"scenario": "gusty-stop-and-go-v0", "interval": 5, "threat": {"kinds": ["dos_hold"]}, "menu": {"thresholds": [1.0], "modes": ["brake"]}}
    sums = {}
    for name, extra in {"zero": {"payoff": "zero_sum"}, "care": {"gap_cost": 0.0, "mode_cost": 0.02, "alarm_cost": 0.05}}.items():
        env = tailgate.parallel_env(**attack, **extra)
        env.reset(seed=1)
        paid, modes, alarms = [], 0, 0
        for _ in range(8):  # before the onset nothing attacks
            memory = env.game.loop.defence.memory
            _, rewards, _, _, _ = env.step({"attacker": 0, "defender": 0})
            modes += (env.game.loop.defence.memory.asked - memory.asked)[0]
            alarms += (env.game.loop.defence.memory.alarmed - memory.alarmed)[0]
            paid.append(rewards["defender"])
            assert name != "zero" or rewards["defender"] == -rewards["attacker"]
        sums[name] = sum(paid), modes, alarms
    total, modes, alarms = sums["care"]
    assert modes >= alarms > 0
    np.testing.assert_allclose(total, -0.1 * (0.02 * modes + 0.05 * alarms))
    env = tailgate.parallel_env(**GUSTY, threat={"kinds": ["fdi"]}, value=-8.0, menu={"thresholds": [1e9], "modes": ["normal"]}, gap_cost=0.0)
    env.reset(seed=0)
    last = []
    while env.agents:
        _, rewards, terminated, _, info = env.step({"attacker": 2, "defender": 0})
        last.append(rewards["defender"])
    assert terminated["defender"] and info["attacker"]["collided"] and last == [0.0] * (len(last) - 1) + [-1.0]


@pytest.mark.long
def test_a_trained_defender_is_an_ordinary_defence(tmp_path, short):
    """An exported network that always chooses a setting plays as that setting, from text; a pair is drawn by episode, alone or in a batch."""
    duel = Duel.make(**GUSTY)
    paths = [export(tmp_path / f"d{n}", duel, constant(duel, n), {"learner": "none"}) for n in (5, 12)]
    place = short("gusty-stop-and-go-v0", horizon=80)
    hashes = {}
    for n, path in zip((5, 12), paths, strict=True):
        one, two = (played(place, text, "fdi_gaussian", range(12)) for text in (f"steered:policy={path}", f"steered:menu.interval=20,setting={n}"))
        hashes[n] = [two.trace_hash(i) for i in range(12)]
        assert [one.trace_hash(i) for i in range(12)] == hashes[n]
    pair = Steered(policy=tuple(paths))
    mixed = [played(place, pair, "fdi_gaussian", range(12)).trace_hash(i) for i in range(12)]
    whose = [[mixed[i] == hashes[n][i] for i in range(12)] for n in (5, 12)]
    assert all(a != b for a, b in zip(*whose, strict=True)) and 0 < sum(whose[0]) < 12
    assert played(place, pair, "fdi_gaussian", [7]).trace_hash(0) == mixed[7]
    env = gymnasium.make("tailgate/CarFollowing-v0", scenario="gusty-stop-and-go-v0", defence=f"steered:policy={paths[0]}")
    env.reset(seed=0)  # the attacker's view against this policy
    assert env.step(0)[4]["step"] == 2


def test_the_defenders_view_is_a_gymnasium_environment():
    """Both checkers are content without a warning, episodes of a seed repeat, a list of attacks draws one each, and the game of the parallel API is the same."""
    from gymnasium.utils.env_checker import check_env
    from stable_baselines3.common.env_checker import check_env as check_sb3

    env = gymnasium.make("tailgate.envs.gym.duel:tailgate/Defender-v0", attack=["none", "fdi:trigger=near,threshold=40,value=-4"], **GUSTY)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
        check_sb3(env.unwrapped, skip_render_check=True)
    first, again = env.reset(seed=4)[0], env.reset(seed=4)[0]
    np.testing.assert_array_equal(first, again)
    quiet = gymnasium.make("tailgate.envs.gym.duel:tailgate/Defender-v0", attack="none", **GUSTY)
    quiet.reset(seed=4)
    game = tailgate.parallel_env(**GUSTY)
    game.reset(seed=4)
    for action in (3, 3, 14, 0, 9):
        seen, paid, *_ = quiet.step(action)
        both, rewards, *_ = game.step({"attacker": 0, "defender": action})
        np.testing.assert_array_equal(seen, both["defender"])
        assert paid == rewards["defender"]


def test_cards_name_the_whole_game():
    """JSON with a hash of its own: every argument of either side counts, and for the defender's view the attack."""
    game = {"interval": 20}
    changes = [
        {"payoff": "zero_sum"}, {"mode_cost": 0.02}, {"alarm_cost": 0.02}, {"gap_cost": 0.02}, {"menu": {"modes": ["normal"]}}, {"menu": {"thresholds": [9]}},
        {"defender_action": "box"}, {"defence": "cusum_kf"}, {"scenario": "braking-v0"}, {"threat": {"budget": 5}}, {"interval": 21}, {"value": -3.0},
    ]  # fmt: skip
    cards = [tailgate.parallel_env(**(game | change)).card() for change in ({}, *changes)]
    assert cards[0] == json.loads(json.dumps(tailgate.parallel_env(**game).card())) and len({card["hash"] for card in cards}) == 1 + len(changes)
    views = [DefenderEnv(attack=attack, **game).card() for attack in ("none", "fdi", "fdi:value=-3", ["none", "fdi"])]
    assert json.loads(json.dumps(views[2])) == views[2] == DefenderEnv(attack="fdi:value=-3", **game).card()
    assert len({card["hash"] for card in (cards[0], *views)}) == 1 + len(views)
    assert DefenderEnv(attack="fdi", payoff="zero_sum", **game).card()["hash"] != views[1]["hash"]


def test_the_box_reaches_the_ends_and_the_middle():
    """-1, 0 and 1 are the least, the geometric middle and the largest threshold; thirds of the way choose the modes."""
    knob = Knob("threshold", (4.0, 100.0), 20.0, True)
    np.testing.assert_allclose(knob.at(np.array([-1.0, 0.0, 1.0, 5.0])), [4.0, 20.0, 100.0, 100.0])
    mode = Knob("mode", (0.0, 1.0, 2.0), 0.0)
    np.testing.assert_array_equal(mode.at(np.array([-1.0, -0.4, -0.3, 0.3, 0.4, 1.0])), [0, 0, 1, 1, 2, 2])
    np.testing.assert_allclose(Knob("challenge", (0.0, 0.4), 0.1, True).at(np.array([0.0])), [0.2])  # 0 has no logarithm


@pytest.mark.parametrize("wrong, words", [
    ({"defence": "chi2_kff"}, ["did you mean 'chi2_kf'"]), ({"defence": "kf"}, ["steered defence", "ChiSquare"]), ({"defence": 3}, ["defence", "3"]),
    ({"defence": "steered:setting=2"}, ["knobs are free"]), ({"defence": "steered:defence=cra"}, ["steered_cra"]),
    ({"defence": "steered:defence=composed,defence.detector=os:Mine"}, ["registered names"]), ({"defence": "os:path"}, ["imports nothing"]),
    ({"menu": {"levels": [1]}}, ["menu", "levels"]), ({"menu": {"thresholds": []}}, ["menu.thresholds"]), ({"menu": {"modes": ["fast"]}}, ["menu.modes"]),
    ({"menu": 3}, ["menu"]), ({"mode_cost": -1}, ["mode_cost"]), ({"payoff": "all"}, ["payoff"]), ({"defender_action": "x"}, ["menu"]),
    ({"scenarioo": "x"}, ["scenarioo"]), ({"interval": 0}, ["interval"]), ({"render_mode": "ansi"}, ["rgb_array"]),
])  # fmt: skip
def test_bad_arguments(wrong, words):
    """One clear error each."""
    with pytest.raises(InputError) as error:
        tailgate.parallel_env(**(GUSTY | wrong))
    assert all(word in str(error.value) for word in words), str(error.value)


def test_bad_actions():
    """A step before reset, after the end, without a player, out of the space."""
    env = tailgate.parallel_env(**GUSTY)
    with pytest.raises(InputError, match="reset"):
        env.step({"attacker": 0, "defender": 0})
    env.reset(seed=0)
    for actions in ({"attacker": 0}, {"attacker": 0, "defender": 15}, {"attacker": -1, "defender": 0}, {"attacker": 0.5, "defender": 0}):
        with pytest.raises(InputError, match="actions"):
            env.step(actions)
    box = tailgate.parallel_env(**GUSTY, defender_action="box")
    box.reset(seed=0)
    with pytest.raises(InputError, match="actions"):
        box.step({"attacker": 0, "defender": [np.nan, 0.0]})


def test_defences_without_a_knob_say_so():
    """A threshold that is computed when the defence is prepared cannot be turned."""
    with pytest.raises(NotApplicable, match="detectors"):
        Hand.on(compose(KalmanFilter(), TailChiSquare(), Widen()), Menu())
    with pytest.raises(NotApplicable, match="nothing but"):
        SteeredChallenge(defence="cra", menu=Menu()) and Steered(defence="pycra")


def test_damaged_and_foreign_files(tmp_path):
    """A defender's file that is damaged, of another menu, or names code is refused, and nothing of it runs."""
    duel = Duel.make(**GUSTY)
    path = export(tmp_path / "d", duel, constant(duel, 1), {})
    header, network = load_defender(path)
    assert header.menu.interval == 20 and network.weights[0].shape == (15, 15)
    data = json.loads(path.read_text())
    changes = [
        ({"format": "x"}, "format"), ({"sha256": "0"}, "sha256"), ({"tensors": "../d.safetensors"}, "tensors"), ({"layers": 2}, "layer1"),
        ({"defence": {"name": "composed", "detector": "os:Mine"}}, "registered"), ({"menu": {"thresholds": [1.0], "modes": ["normal"]}}, "settings"),
        ({"observation": [*data["observation"][:-1], "truth"]}, "truth"), ({"extra": 1}, "extra"),
    ]  # fmt: skip
    place = load_scenario("gusty-stop-and-go-v0")
    for change, word in changes:
        (tmp_path / "bad.json").write_text(json.dumps(data | change))
        with pytest.raises(InputError, match=word):
            place.loop(Steered(policy=tmp_path / "bad.json"), Steered.uses)
    (tmp_path / "bad.json").write_text("{")
    for name in ("bad.json", "missing.json"):
        with pytest.raises(InputError):
            Steered(policy=tmp_path / name)


@pytest.mark.parametrize("change, words", [
    ({"tensors": ""}, r"\.tensors: got ''"), ({"tensors": "a\0b"}, r"\.tensors"), ({"layers": 0}, r"\.layers: got 0"), ({"layers": -1}, r"\.layers: got -1"),
    ({"defence": {"name": "steered", "policy": "bad.json"}}, r"\.defence: got 'steered'"), ({"defence": {"name": "nothing"}}, r"\.defence: got 'nothing'"),
    ({"defence": {"name": 5}}, r"\.defence: got"), ({"defence": {"name": "chi2_kf", "family": "x"}}, r"\.defence chi2_kf.*'family'"),
    ({"defence": {"name": "chi2_kf", "eta": ["os:Mine"]}}, r"\.defence: got .*os:Mine"), ({"defence": 5}, r"\.defence: got 5"),
    ({"menu": {"thresholds": list(range(1, 401)), "modes": ["normal", "widen", "brake"]}}, r"\.menu: got '1200 combinations of settings'.*1024"),
    ({"training": {"x": [[[[]]]]}}, ""),
])  # fmt: skip
def test_a_bad_field_of_a_defender_is_one_clear_error(tmp_path, monkeypatch, change, words):
    """It names the file, the field and the value; a policy that names itself as its defence is no endless loop."""
    monkeypatch.chdir(tmp_path)
    duel = Duel.make(**GUSTY)
    path = export(tmp_path / "bad", duel, constant(duel, 1), {})
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    if not words:
        assert Steered(policy=path).inner_defence
        return
    with pytest.raises(InputError, match=rf"bad\.json.*{words}"):
        Steered(policy=path)


def test_a_defender_nested_too_deep_is_one_clear_error(tmp_path):
    """Also where the reader of JSON gives up before."""
    for depth in (100, 100_000):
        (tmp_path / "bad.json").write_text(f'{{"format": "tailgate-defender-1", "training": {"[" * depth}{"]" * depth}}}')
        with pytest.raises(InputError, match=r"bad\.json.*nested"):
            Steered(policy=tmp_path / "bad.json")


def test_a_menu_has_a_thousand_settings_at_most():
    """A thousand and twenty-four: of the knobs that the defence has."""
    levels = tuple(float(n) for n in range(1, 1026))
    assert Steered(menu=Menu(thresholds=levels[:1024], modes=("widen",))).hand.knobs
    with pytest.raises(InputError, match="1025 combinations"):
        Steered(menu=Menu(thresholds=levels, modes=("widen",)))


def test_the_examples_of_the_documentation_run(capsys):
    """Both Python examples, as they stand; a game pays both."""
    text = (Path(__file__).parents[1] / "docs/two-players.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert len(blocks) == 2
    for block in blocks:
        exec(block, {})
    paid = ast.literal_eval(capsys.readouterr().out)
    assert set(paid) == {"attacker", "defender"} and paid["attacker"] != 0.0 and paid["defender"] < 0.0


def test_the_attacker_is_told_what_every_environment_tells():
    env = tailgate.parallel_env()
    _, infos = env.reset(seed=0)
    names = gymnasium.make("tailgate:tailgate/CarFollowing-v0").reset(seed=0)[1].keys()
    assert infos["attacker"].keys() == names
