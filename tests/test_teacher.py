"""What a learner is shown before it learns: the actions nearest to a script, what they brought, and a policy that decides like them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate.agents.learners import cem, teacher
from tailgate.agents.learners.learning import Teachable, learner_of
from tailgate.agents.learners.ppo import Config, Learner
from tailgate.agents.learners.teacher import demonstrate, nearest
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError
from tailgate.core import Kind, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import config_path
from tailgate.engine.tracing import traced
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.estimators import Kalman
from tailgate.play.metrics import crashed
from tailgate.play.trace import rollout
from tailgate.training import train

SCRIPT = "fdi_then_jam:trigger=near,threshold=40,inject=10"
ENVIRONMENT: dict[str, Any] = {
    "scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf", "threat": {"kinds": ["dos_jam", "fdi"], "budget": 20, "fdi_bound": 3.0}, "value": -3.0,
    "interval": 5, "reward": "collision", "gap_shaping": 0.0, "error_shaping": 0.0, "gamma": 0.9,
}
SMALL = Config(envs=16, rollout=24, batch_size=192, epochs=1, hidden=(16,))


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file with a fifth of the scenario's time."""
    place = config_path("scenarios", ENVIRONMENT["scenario"], "scenario").read_text()
    for whole, part in (("horizon: 600", "horizon: 120"), ("onset: 50", "onset: 10"), ("end: 500", "end: 120")):
        assert whole in place
        place = place.replace(whole, part)
    path = tmp_path_factory.mktemp("brief") / "brief.yaml"
    path.write_text(place)
    return str(path)


def attack(text: str) -> Any:
    return Spec("attack", text).make()


def test_the_nearest_action_has_the_commands_kind_targets_and_value() -> None:
    """Every mode's own command is nearest to itself; of two values the nearer, of two targets the one that differs in fewer wires."""
    seat = Seat.make(**(ENVIRONMENT | {"per_sensor": True, "interval": 1}))
    view = seat.loop.sense(seat.loop.start(draws.keys("train", range(seat.action.size))))
    actions = np.arange(seat.action.size)
    command = seat.action.decode(actions, view)
    assert nearest(seat.action, command).tolist() == actions.tolist()
    shifted = command._replace(value=np.where(command.target, command.value + 0.4, 0.0))
    assert nearest(seat.action, shifted).tolist() == actions.tolist()
    other = command._replace(kind=np.where(command.kind == Kind.FDI, Kind.REPLAY, command.kind).astype(np.int8))
    assert (nearest(seat.action, other)[command.kind == Kind.FDI] == 0).all()


@pytest.mark.long
def test_a_demonstration_is_the_script_and_its_returns() -> None:
    """Rest until the trigger, then ten steps of bias in two decisions, then jamming; a collision at the end is worth gamma to the steps before it."""
    seat = Seat.make(**ENVIRONMENT)
    shown = demonstrate(seat, attack(SCRIPT), 0, episodes=64)
    names = [mode.name for mode in seat.action.modes]
    counts = {name: int((shown.action == j).sum()) for j, name in enumerate(names)}
    assert counts["fdi-"] == 2 * counts["dos_jam"] or abs(counts["fdi-"] - counts["dos_jam"]) <= 64  # some collide before they jam
    assert counts["fdi+"] == 0 and 64 <= counts["fdi-"] <= 128 and counts["dos_jam"] > 0
    left = shown.observation[:, seat.observation.names.index("budget_left")]
    assert np.allclose(left[shown.action == names.index("fdi-")] % 0.25, 0.0)  # five steps of twenty a decision
    powers = np.log(shown.gained[shown.gained > 0]) / np.log(0.9)
    np.testing.assert_allclose(powers, np.round(powers), atol=1e-9)
    assert demonstrate(seat, attack(SCRIPT), 0, episodes=64).action.tolist() == shown.action.tolist()
    other = demonstrate(seat, attack(SCRIPT), 1, episodes=64)
    assert not np.array_equal(other.observation[:64], shown.observation[:64])


def test_a_long_demonstration_is_played_by_a_traced_program_with_the_same_bits(brief: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames are shown at each decision; another script of the class is traced no more."""
    seat = Seat.make(**(ENVIRONMENT | {"scenario": brief, "interval": 1, "frames": 2}))
    scripts = [attack(f"fdi_then_jam:start_step={step},inject=10") for step in (30, 50)]
    traces: list[int] = []
    monkeypatch.setattr("tailgate.play.trace.LONG", 1)
    monkeypatch.setattr(teacher, "traced", lambda *arguments: traces.append(1) or traced(*arguments))
    found = [demonstrate(seat, script, 0, episodes=7) for script in scripts]
    assert len(traces) == 1
    monkeypatch.setattr("tailgate.play.trace.LONG", 10**9)
    plain = [demonstrate(seat, script, 0, episodes=7) for script in scripts]
    assert [[part.tobytes() for part in one] for one in found] == [[part.tobytes() for part in one] for one in plain]
    assert found[0].observation.shape[1] == 2 * len(seat.observation.columns) and not np.array_equal(found[0].action, found[1].action)


def test_a_defence_that_fails_ends_a_traced_demonstration_with_the_plain_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Lost(Kalman):
        def step(self, plan: Any, state: Any, received: Any, known_u: Any, draws: Any = None) -> Any:
            state, estimate = super().step(plan, state, received, known_u, draws)
            return state, estimate._replace(x=np.where(received.y[..., :1] < 45.0, np.nan, estimate.x))

    seat = Seat.make(**(ENVIRONMENT | {"interval": 1, "defence": Lost()}))
    with pytest.raises(InputError) as found:
        demonstrate(seat, attack(SCRIPT), 0, episodes=3)
    monkeypatch.setattr("tailgate.play.trace.LONG", 10**9)
    with pytest.raises(InputError) as wanted:
        demonstrate(seat, attack(SCRIPT), 0, episodes=3)
    assert str(found.value) == str(wanted.value)


@pytest.mark.long
def test_who_was_shown_a_script_does_what_it_does(tmp_path: Path) -> None:
    """Before any learning of its own the policy collides about as often as its teacher, where an untaught one does not collide at all."""
    learner = Learner(0, 0.9, SMALL, {k: v for k, v in ENVIRONMENT.items() if k != "gamma"})
    keys = draws.keys("tune", range(200))
    before = learner.export(tmp_path / "before", {})
    learner.imitate(demonstrate(learner.seat, attack(SCRIPT), 0, episodes=512))
    after = learner.export(tmp_path / "after", {})
    rates = [float(crashed(rollout(learner.seat.loop, rival, keys)).mean()) for rival in (PolicyAttack(before), PolicyAttack(after), attack(SCRIPT))]
    assert rates[0] < 0.05 and rates[2] > 0.3 and rates[1] > 0.6 * rates[2], rates


@pytest.mark.long
def test_a_taught_run_resumes_to_the_same_policy(tmp_path: Path, brief: str) -> None:
    """The lesson comes before the first decision, once: an interrupted run is not taught again."""
    script = "fdi_then_jam:start_step=30,inject=20"
    settings = [
        "seeds=1", "workers=1", "environment.interval=20", "ppo.envs=16", "ppo.rollout=15", "ppo.batch_size=120", "ppo.epochs=1", "ppo.hidden=[8]",
        "tensorboard=false", "checkpoint_every=240", f"teacher='{script}'", "white_box=[]", f"scenario={brief}",
    ]
    entire = train.load_config("gusty", [f"out={tmp_path / 'whole'}", "steps=960", *settings])
    straight = train.train(entire, lambda seed, now: None)[0].with_suffix(".safetensors").read_bytes()
    parts = [f"out={tmp_path / 'parts'}", *settings]
    train.train(train.load_config("gusty", ["steps=480", *parts]), lambda seed, now: None)
    again = train.train(train.load_config("gusty", ["steps=960", *parts]), lambda seed, now: None, resume=True)
    assert again[0].with_suffix(".safetensors").read_bytes() == straight
    untaught = train.load_config("gusty", [f"out={tmp_path / 'own'}", "steps=960", *settings, "teacher=none"])
    assert train.train(untaught, lambda seed, now: None)[0].with_suffix(".safetensors").read_bytes() != straight


@pytest.mark.long
@pytest.mark.parametrize("hidden", [(), (8,)])
def test_a_search_begins_at_what_it_was_shown(tmp_path: Path, hidden: tuple[int, ...]) -> None:
    """The cross-entropy method's first mean decides as the script does, whatever the layers; its last layer has the scale 1."""
    settings = {k: v for k, v in ENVIRONMENT.items() if k != "gamma"}
    search = cem.Learner(0, 0.9, cem.Config(hidden=hidden), settings)
    keys = draws.keys("tune", range(200))
    shown = demonstrate(search.seat, attack(SCRIPT), 0, episodes=512)
    search.imitate(shown)
    rates = [float(crashed(rollout(search.seat.loop, rival, keys)).mean()) for rival in (PolicyAttack(search.export(tmp_path / "p", {})), attack(SCRIPT))]
    assert rates[1] > 0.3 and rates[0] > 0.6 * rates[1], rates
    last = np.concatenate([part.ravel() for part in search.shape.layers(search.mean)[-1]])
    assert np.sqrt(np.mean(last**2)) == pytest.approx(1.0)
    again = cem.Learner(0, 0.9, cem.Config(hidden=hidden), settings)
    again.imitate(shown)
    assert np.array_equal(again.mean, search.mean)


def test_the_slope_of_an_imitation_is_that_of_its_loss() -> None:
    """Backpropagation through tanh layers against central differences."""
    rng = np.random.default_rng(0)
    shape = cem.Shape(((3, 5), (5, 4), (4, 2)))
    theta, seen, action = rng.standard_normal(shape.length), rng.standard_normal((7, 3)), rng.integers(0, 2, 7)

    def loss(theta: np.ndarray) -> float:
        x = cem.outputs([(w, b[None]) for w, b in shape.layers(theta)], seen[None])
        return float(np.mean(np.log(np.exp(x).sum(axis=1)) - x[np.arange(7), action]))

    numeric = [(loss(theta + 1e-6 * e) - loss(theta - 1e-6 * e)) / 2e-6 for e in np.eye(shape.length)]
    np.testing.assert_allclose(cem._slope(shape, theta, seen, action), numeric, atol=1e-8)


@pytest.mark.parametrize("learner", ["recurrent_ppo", "dqn", "sac", "tqc"])
def test_learners_that_cannot_be_shown_anything_say_so(tmp_path: Path, learner: str) -> None:
    assert not issubclass(learner_of(learner).Learner, Teachable)
    action = "continuous" if learner in ("sac", "tqc") else "mode"
    config = train.load_config("gusty", [f"out={tmp_path}", f"learner={learner}", f"environment.action={action}", f"teacher='{SCRIPT}'"])
    with pytest.raises(InputError, match=r"config\.teacher"):
        train.train(config, lambda seed, now: None)
    assert not list(tmp_path.iterdir())


def test_what_is_shown_is_one_of_a_few_actions(tmp_path: Path) -> None:
    config = train.load_config("gusty", [f"out={tmp_path}", "environment.action=continuous", f"teacher='{SCRIPT}'"])
    with pytest.raises(InputError, match=r"config\.teacher.*timing, mode, ramp"):
        train.train(config, lambda seed, now: None)
    with pytest.raises(InputError, match="nosuch"):
        train.load_config("gusty", ["teacher=nosuch"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["teacher=best", "rivals=[]"], ["best", "rivals"]), (["teacher=optimal_dos"], ["optimal_dos", "computed optimum"]),
        (["teacher='zoo:name=car-following-chi2_kf-0'"], ["zoo", "learned"]), (["teacher=stealth"], ["stealth", "knows no more"]),
        (["teacher='fdi:targets=[nowhere]'"], ["nowhere"]),
    ],
)  # fmt: skip
def test_a_teacher_is_a_script_that_knows_no_more(tmp_path: Path, changes: list[str], words: list[str]) -> None:
    """Neither a computed optimum nor a trained policy, nothing that sees more than the learner, and nobody at all is an error, before anything is written."""
    config = train.load_config("gusty", [f"out={tmp_path}", *changes])
    with pytest.raises(InputError) as error:
        train.train(config, lambda seed, now: None)
    assert all(word in str(error.value) for word in words)
    assert not list(tmp_path.iterdir())


def test_a_script_whose_kind_no_action_has_teaches_nobody() -> None:
    """Its demonstrations would be those of rest."""
    seat = Seat.make(**ENVIRONMENT | {"threat": {"kinds": ["dos_jam"], "budget": 20}, "value": 0.0})
    with pytest.raises(InputError, match="with a kind that an action has: dos_jam"):
        demonstrate(seat, attack("fdi:trigger=near,threshold=40,value=-3"), 1, 8)
