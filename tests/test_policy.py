"""Learned policies: files, playing as an attack, yoked schedules."""

import dataclasses
import hashlib
import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tailgate.agents.policy.network_policy import PolicyAttack, Yoked, choose, load_policy, save_policy
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.neural import Network
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario, load_suite
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.envs.plants.sensor_network import SensorNetwork
from tailgate.play.metrics import METRICS, crashed
from tailgate.play.trace import Recorder, rollout, signals_of
from tailgate.studies.timing import timing_advantage

THREAT = {"onset": 10, "budget": 20, "kinds": ["dos_jam", "fdi"], "fdi_bound": 5.0}
SEEDS = list(range(12))


MANY: dict[str, dict[str, Any]] = {  # several agents: the scenario, and the environment's other arguments
    "platoon-braking-v0": {"defence": "lasso_dkf", "threat": {"onset": 10, "budget": 60, "targets": ["distance"], "agents": [1, 3]}},
    "thesis-ch5-v0": {"defence": "norm_resilient", "threat": {"budget": 20}, "reward": "error"},
}


def _place(knowledge: str, scenario: str = "gusty-stop-and-go-v0") -> Scenario:
    threat: dict[str, Any] = MANY[scenario]["threat"] if scenario in MANY else THREAT
    return load_scenario(scenario).with_threat(**threat, knowledge=knowledge)


def _policy(path: Path, action: dict[str, Any], knowledge: str = "black", seed: int = 0, scenario: str = "gusty-stop-and-go-v0", frames: int = 1) -> Path:
    """A random network that attacks now and then."""
    brief = _place(knowledge, scenario).brief()
    spec = ActionSpec(**action)
    codec, names = ActionCodec(spec, brief), ObservationCodec(brief, frames).names
    rng = np.random.default_rng(seed)
    weights = (rng.normal(size=(len(names), 16)), rng.normal(size=(16, codec.size)))
    network = Network(weights, (rng.normal(size=16), rng.normal(size=codec.size)), None if codec.discrete else np.full(codec.size, -1.0))
    header = {
        "action": spec, "observation": names, "knowledge": knowledge, "sees_measurement": False, "frames": frames,
        "agents": brief.model.agents, "training": {},
    }  # fmt: skip
    return save_policy(path / "policy", network, header)


@pytest.mark.thin(27)
@pytest.mark.parametrize("interval", [1, 5])
@pytest.mark.parametrize("knowledge", ["black", "white"])
@pytest.mark.parametrize("action", ["timing", "mode", "ramp", "continuous", "increment"])
def test_stepping_the_environment_and_playing_as_an_attack_give_one_trace(tmp_path: Path, action: str, knowledge: str, interval: int) -> None:
    _same_trace(tmp_path, {"action": action, "interval": interval, "rate": 0.5}, knowledge, "gusty-stop-and-go-v0", {"threat": THREAT})


@pytest.mark.long
def test_a_policy_of_several_frames_plays_as_it_was_trained(tmp_path: Path) -> None:
    """What it remembers of earlier decisions is what the environment showed."""
    _same_trace(tmp_path, {"action": "mode", "interval": 3}, "black", "gusty-stop-and-go-v0", {"threat": THREAT, "frames": 4})


@pytest.mark.parametrize("scenario", MANY)
@pytest.mark.parametrize(("action", "knowledge"), [({"action": "mode", "per_agent": True}, "black"), ({"action": "increment"}, "white")])
@pytest.mark.thin(4)
def test_a_policy_of_many_agents_plays_as_it_was_trained(tmp_path: Path, scenario: str, action: dict[str, Any], knowledge: str) -> None:
    _same_trace(tmp_path, action | {"interval": 3}, knowledge, scenario, MANY[scenario])


def _same_trace(tmp_path: Path, spec: dict[str, Any], knowledge: str, scenario: str, arguments: dict[str, Any]) -> None:
    """The environment stepped with a policy's choices, and the policy played as an attack: bit for bit."""
    path = _policy(tmp_path, spec, knowledge, scenario=scenario, frames=arguments.get("frames", 1))
    _, network = load_policy(path)
    env = AdversaryVectorEnv(len(SEEDS), scenario=scenario, knowledge=knowledge, autoreset="disabled", engine="plain", **arguments, **spec)
    loop, interval = dataclasses.replace(env.seat.loop, horizon=min(100 if scenario in MANY else 299, env.seat.loop.horizon)), spec["interval"]
    env.seat = env.episodes.seat = dataclasses.replace(env.seat, loop=loop)
    played = rollout(loop, PolicyAttack(path), draws.keys("train", SEEDS))

    observation, _ = env.reset(seed=SEEDS[0])
    assert env.state is not None
    recorder = Recorder(loop, env.state)
    advance = loop.advance

    def recorded(state: Any, command: Any) -> Any:  # every step inside of a decision, as the environment makes them
        live = ~state.ended & (state.k <= loop.horizon)
        state, frame = advance(state, command)
        if live.any() and recorder.steps < loop.horizon:
            recorder.put(signals_of(frame), live)
        return state, frame

    object.__setattr__(loop, "advance", recorded)
    for _ in range(-(-loop.horizon // interval)):
        observation, *_ = env.step(choose(network, env.seat.action, observation))
        env.over[:] = False  # play on: the recorder knows which rows are over
    stepped = recorder.trace()
    assert (played.kind != 0).any()
    assert [stepped.trace_hash(i) for i in range(len(SEEDS))] == [played.trace_hash(i) for i in range(len(SEEDS))]


@pytest.mark.long
@pytest.mark.parametrize("action", ["mode", "increment"])
def test_a_stochastic_policy_repeats_whatever_the_batch(tmp_path: Path, action: str) -> None:
    path = _policy(tmp_path, {"action": action})
    loop = dataclasses.replace(_place("black"), horizon=100).loop(Spec("defence", "kf").make())
    together = rollout(loop, PolicyAttack(path, stochastic=True), draws.keys("report", SEEDS))
    alone = [rollout(loop, PolicyAttack(path, stochastic=True), draws.keys("report", [s])).trace_hash(0) for s in SEEDS[:4]]
    assert [together.trace_hash(i) for i in range(4)] == alone
    calm = rollout(loop, PolicyAttack(path), draws.keys("report", SEEDS))
    assert any(together.trace_hash(i) != calm.trace_hash(i) for i in range(len(SEEDS)))


def test_what_is_saved_is_what_is_loaded(tmp_path: Path) -> None:
    path = _policy(tmp_path, {"action": "increment", "rate": 0.7, "interval": 3})
    header, network = load_policy(path)
    assert header.action == ActionSpec(action="increment", rate=0.7, interval=3)
    rng = np.random.default_rng(0)
    assert np.array_equal(network.weights[0], rng.normal(size=network.weights[0].shape))
    assert network.log_std is not None and (network.log_std == -1.0).all()


def test_a_yoked_policy_attacks_exactly_when_its_schedule_says(tmp_path: Path) -> None:
    path = _policy(tmp_path, {"action": "mode", "interval": 2})
    loop = dataclasses.replace(_place("black"), horizon=220).loop(Spec("defence", "kf").make())
    schedule = np.zeros((loop.horizon, len(SEEDS)), bool)
    for row in range(len(SEEDS)):
        schedule[100 + 10 * row : 105 + 10 * row, row] = True
    trace = rollout(loop, Yoked(PolicyAttack(path), schedule), draws.keys("report", SEEDS), terminate=False)
    assert np.array_equal(trace.kind != 0, schedule)


@pytest.mark.long
def test_a_policy_without_timing_has_no_timing_advantage(tmp_path: Path) -> None:
    """A policy that attacks at the same steps in every episode is its own yoked twin."""
    brief = _place("black").brief()
    names = ObservationCodec(brief).names
    weight = np.zeros((len(names), 4))
    weight[names.index("progress"), 3] = 100.0  # fdi-: whenever anything is left of the budget
    header = {"action": ActionSpec(action="mode"), "observation": names, "knowledge": "black", "sees_measurement": False, "training": {}}
    path = save_policy(tmp_path / "policy", Network((weight,), (np.zeros(4),)), header)
    loop = _place("black").loop(Spec("defence", "chi2_kf").make())
    keys = draws.keys("report", range(40))
    own, yoked = timing_advantage(loop, PolicyAttack(path), keys)
    assert np.array_equal(own, yoked)
    assert np.array_equal(own, crashed(rollout(loop, PolicyAttack(path), keys)))


def _damage(path: Path, how: str) -> None:
    data = json.loads(path.read_text())
    tensors = path.with_suffix(".safetensors")
    match how:
        case "not json":
            path.write_text("{")
        case "other format":
            path.write_text(json.dumps(data | {"format": "something"}))
        case "unknown field":
            path.write_text(json.dumps(data | {"speed": 3}))
        case "no tensors":
            tensors.unlink()
        case "flipped bit":
            blob = bytearray(tensors.read_bytes())
            blob[-3] ^= 1
            tensors.write_bytes(bytes(blob))
        case "truncated":
            tensors.write_bytes(tensors.read_bytes()[:100])
        case "path outside":
            path.write_text(json.dumps(data | {"tensors": "../policy.safetensors"}))
        case "too many layers":
            path.write_text(json.dumps(data | {"layers": 3}))
        case "unknown action":
            path.write_text(json.dumps(data | {"action": data["action"] | {"action": "fly"}}))


@pytest.mark.parametrize(
    ("how", "field"),
    [
        ("not json", "JSON"), ("other format", "format"), ("unknown field", "speed"), ("no tensors", "tensors"), ("flipped bit", "sha256"),
        ("truncated", "sha256"), ("path outside", "tensors"), ("too many layers", "layer2"), ("unknown action", "action"),
    ],
)  # fmt: skip
def test_a_damaged_policy_is_refused_with_one_clear_error(tmp_path: Path, how: str, field: str) -> None:
    path = _policy(tmp_path, {"action": "mode"})
    _damage(path, how)
    with pytest.raises(InputError, match=field):
        Spec("attack", str(path)).make().prepare(_place("black").brief())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"layers": 0}, "layers"), ({"layers": -1}, "layers"), ({"layers": 1.5}, "layers"), ({"layers": 10**9}, "layer2"), ({"layers": 10**30}, "layers"),
        ({"tensors": ""}, "tensors"), ({"tensors": "a\0b"}, "tensors"), ({"tensors": "\ud800"}, "tensors"), ({"tensors": ".."}, "tensors"),
        ({"tensors": 5}, "tensors"), ({"frames": 10**9}, "frames"), ({"training": 5}, "training"), ({"observation": []}, "layer0"),
        ({"training": {"x": [[[]]] * 3}}, ""),
    ],
)  # fmt: skip
def test_a_bad_field_is_one_clear_error(tmp_path: Path, change: dict[str, Any], field: str) -> None:
    """It names the file, the field and the value; what a record holds besides is nobody's business."""
    path = _policy(tmp_path, {"action": "mode"})
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    if not field:
        assert load_policy(path)[0].training == change["training"]
        return
    with pytest.raises(InputError, match=rf"policy\.json.*{field}.* got .*; expected"):
        load_policy(path)


@pytest.mark.parametrize("depth", [65, 900, 100_000])
def test_deep_nesting_is_one_clear_error(tmp_path: Path, depth: int) -> None:
    """Whether the reader of JSON gives up first or what would walk through the data; as deep as is allowed it is read."""
    path = _policy(tmp_path, {"action": "mode"})
    text = json.dumps(json.loads(path.read_text()) | {"training": {"x": "nested"}})
    path.write_text(text.replace('"nested"', "[" * 62 + "]" * 62))
    assert load_policy(path)[0].training["x"]
    path.write_text(text.replace('"nested"', "[" * depth + "]" * depth))
    with pytest.raises(InputError, match=r"policy\.json.*nested"):
        load_policy(path)


@pytest.mark.parametrize("kind", [np.int64, np.bool_, np.complex64])
def test_weights_are_floating_point_numbers(tmp_path: Path, kind: Any) -> None:
    path = _policy(tmp_path, {"action": "mode"})
    tensors = load_tensors(path.with_suffix(".safetensors").read_bytes())
    blob = save_tensors(tensors | {"layer1.bias": tensors["layer1.bias"].astype(kind)})
    path.with_suffix(".safetensors").write_bytes(blob)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sha256": hashlib.sha256(blob).hexdigest()}))
    with pytest.raises(InputError, match="layer1"):
        load_policy(path)


def test_a_type_of_number_that_numpy_lacks_is_one_clear_error(tmp_path: Path) -> None:
    """Sixteen bits of brain floating point."""
    path = _policy(tmp_path, {"action": "mode"})
    head = json.dumps({"layer0.weight": {"dtype": "BF16", "shape": [1, 1], "data_offsets": [0, 2]}}).encode()
    blob = len(head).to_bytes(8, "little") + head + b"\0\0"
    path.with_suffix(".safetensors").write_bytes(blob)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sha256": hashlib.sha256(blob).hexdigest()}))
    with pytest.raises(InputError, match=r"policy\.json"):
        load_policy(path)


@pytest.mark.parametrize("other", ["platoon-20-v0", "thesis-ch5-v0", "gusty-stop-and-go-v0"])
def test_a_policy_of_another_size_is_refused(tmp_path: Path, other: str) -> None:
    """In one short line that says how many agents it was made for; also where the observations would agree."""
    path = _policy(tmp_path, {"action": "mode"}, scenario="platoon-braking-v0")
    agents = load_scenario(other).brief().model.agents
    with pytest.raises(InputError, match=rf"a policy for 5 agents.*this scenario's {agents} agents?") as caught:
        PolicyAttack(path).prepare(load_scenario(other).brief())
    assert len(str(caught.value)) < 200
    network = _policy(tmp_path, {"action": "mode"}, scenario="thesis-ch5-v0")
    plant = SensorNetwork(agents=12, graph="ring")
    place = dataclasses.replace(load_scenario("thesis-ch5-v0"), plant=plant).with_threat(budget=20)
    assert ObservationCodec(place.brief()).names == load_policy(network)[0].observation
    with pytest.raises(InputError, match=r"10 agents.*12 agents"):
        PolicyAttack(network).prepare(place.brief())


def test_an_error_names_some_of_many_observations(tmp_path: Path) -> None:
    path = _policy(tmp_path, {"action": "mode"}, scenario="thesis-ch5-v0")
    other = load_scenario("thesis-ch5-v0").with_threat(knowledge="white", agents=(3,))
    with pytest.raises(InputError, match=r"and \d+ more") as caught:
        PolicyAttack(path).prepare(other.brief())
    assert len(str(caught.value)) < 300


@pytest.mark.long
def test_a_timing_advantage_counts_any_metric(tmp_path: Path) -> None:
    """The outcome is a metric's; where nothing collides it is an error."""
    path = _policy(tmp_path, {"action": "mode"}, scenario="thesis-ch5-v0")
    spec = Spec("defence", "norm_resilient")
    loop, keys = _place("black", "thesis-ch5-v0").loop(spec.make(), spec.entry.uses), draws.keys("report", range(6))
    own, yoked = timing_advantage(loop, PolicyAttack(path), keys, "rmse_position")
    assert np.array_equal(own, METRICS["rmse_position"](rollout(loop, PolicyAttack(path), keys)))
    assert (yoked > 0.0).all() and not timing_advantage(loop, PolicyAttack(path), keys)[0].any()


def test_a_policy_of_another_observation_is_refused(tmp_path: Path) -> None:
    path = _policy(tmp_path, {"action": "mode"}, "white")
    with pytest.raises(InputError, match="error0"):
        PolicyAttack(path).prepare(_place("black").brief())


def test_a_policy_of_another_number_of_actions_is_refused(tmp_path: Path) -> None:
    """A mode of one kind is no mode of two."""
    place = _place("black")
    fewer = place.with_threat(kinds=("fdi",))
    with pytest.raises(InputError, match=r"got '4 actions'; expected 3, as environment.action=mode has under this threat model \(none, fdi"):
        PolicyAttack(_policy(tmp_path, {"action": "mode"})).prepare(fewer.brief())


def test_a_policy_that_does_not_fit_names_the_options_of_its_training(tmp_path: Path) -> None:
    """As a command line takes them; nothing of a file that does not know them, or has anything else there."""
    threat = {"kinds": ["dos_jam", "fdi"], "fdi_bound": 3.0, "end": None, "knowledge": "black"}
    path = _policy(tmp_path, {"action": "mode"})
    plain, fewer = json.loads(path.read_text()), _place("black").with_threat(kinds=("fdi",)).brief()
    told = r"; it was trained with --scenario braking-v0 --threat 'kinds=\[\"dos_jam\", \"fdi\"\]' --threat fdi_bound=3.0 --threat end=null --threat knowledge=black$"
    bare = r"(expected 3, .* under this threat model \(none, fdi\+, fdi-\)|the observation of this scenario and threat model)$"
    for config, words in (
        ({"scenario": "braking-v0", "threat": threat}, told), (5, bare), ({"scenario": 5, "threat": "\x1b["}, bare), ({"scenario": "\x1b[2J"}, bare),
    ):  # fmt: skip
        path.write_text(json.dumps(plain | {"training": {"config": config}}))
        for brief in (fewer, _place("white").brief()):
            with pytest.raises(InputError, match=words):
                PolicyAttack(path).prepare(brief)


def test_a_policy_outside_of_the_threat_model_names_itself_and_the_remedy() -> None:
    """The options that grant what it was trained with, and the suites that do; with them it plays."""
    policy = PolicyAttack(Path(str(files("tailgate.agents.policies").joinpath("radar-following-kf-0.json"))))
    place = load_scenario("radar-following-v0").with_threat(delay_bound=20.0)
    words = (
        "policy radar-following-kf-0.json: delay: got 60.0; expected at most the threat model's delay_bound (20.0); it was trained with "
        "--scenario radar-following-v0 --threat budget=4; add --threat delay_bound=60.0, or --suite radar-v0 or --suite radar-v1"
    )
    with pytest.raises(InputError, match=f"^{re.escape(words)}$"):
        policy.prepare(place.brief())
    for granted in (place.with_threat(delay_bound=60.0), place.with_threat(**load_suite("radar-v0").granted)):
        assert policy.prepare(granted.brief()).action.spec.delay == 60.0
