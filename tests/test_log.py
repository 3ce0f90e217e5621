"""A log has the episodes as they were, labels that agree with the trace, and nothing that a suite holds out."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import tailgate
from tailgate.agents.policy.zoo import zoo_path
from tailgate.base import files
from tailgate.cli import log as command
from tailgate.core import draws
from tailgate.core.kinds import Kind, Mode
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_suite
from tailgate.envs.recorded import Recorded
from tailgate.evaluation.cells import Cell
from tailgate.evaluation.excluded_attacks import families
from tailgate.play.trace import rollout
from tailgate.studies import log
from tailgate.studies.log import write_log
from tailgate.studies.log_card import readme, recordings_of

from .commands import ran

ATTACKS = ("none", "fdi:start_step=40,value=9,targets=[position]", "dropout:start_step=100", "fdi_ramp:start_step=20")
SUITE = Suite("small", "Small.", ("thesis-ch4-v0",), (12, 30, 50), ("none", "chi2_kf"), ATTACKS, 9, held_out=("fdi_ramp",))
OPTIONS: dict[str, Any] = {"episodes": 3, "dev_episodes": 2, "defences": ["chi2_kf"]}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("log") / "small"
    return out, write_log(SUITE, out, **OPTIONS)


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.thin(2)
@pytest.mark.parametrize(("split", "purpose", "episodes"), [("train", "train", 3), ("dev", "tune", 2)])
def test_a_log_is_the_trace_of_its_episodes(made: tuple[Path, dict[str, Any]], split: str, purpose: str, episodes: int) -> None:
    """Every signal and every label of every step, by the seeds of the split."""
    out, _ = made
    table = pq.read_table(out / split / "thesis-ch4-v0.parquet").to_pandas()
    assert set(table["attack"]) == set(ATTACKS[:3]) and set(table["dose"]) == {30} and set(table["split"]) == {split}
    for attack in ATTACKS[:3]:
        rival = Spec("attack", attack)
        place = Cell("s", "thesis-ch4-v0", 30, "chi2_kf", attack, 1).place(rival.make(), rival.entry.knowledge)
        trace = rollout(place.loop(tailgate.make_defence("chi2_kf")), rival.make(), draws.keys(purpose, range(episodes)))
        for b in range(episodes):
            rows = table[(table["attack"] == attack) & (table["episode"] == b)]
            n = int(trace.length[b])
            assert rows["k"].tolist() == list(range(1, n + 1)) and np.array_equal(rows["t"], rows["k"] * trace.dt)
            for i, name in enumerate(("position", "velocity")):
                assert np.array_equal(rows[f"reading_{name}"], trace.wires[:n, b, 0, i])
                assert np.array_equal(rows[f"truth_sent_{name}"], trace.clean[:n, b, 0, i])
                assert np.array_equal(rows[f"valid_{name}"], trace.valid[:n, b, 0, i])
                assert np.array_equal(rows[f"truth_attacked_{name}"], trace.target[:n, b, 0, i])
            for i in range(3):
                assert np.array_equal(rows[f"estimate_{i}"], trace.estimate[:n, b, 0, i])
                assert np.array_equal(rows[f"truth_state_{i}"], trace.truth[:n, b, 0, i])
            assert np.array_equal(rows["score"], trace.score[:n, b, 0]) and np.array_equal(rows["alarm"], trace.alarm[:n, b, 0])
            assert rows["mode"].tolist() == [Mode(m).name.lower() for m in trace.mode[:n, b, 0]]
            assert rows["attack_kind"].tolist() == [Kind(kind).name.lower() for kind in trace.kind[:n, b]]
            assert np.array_equal(rows["attacked"], trace.kind[:n, b] != 0)
            assert np.array_equal(rows["truth_collided"], (trace.collided | trace.rear_collided)[:n, b])
    assert table["attacked"].sum() == 2 * 30 * episodes  # the dose in each attacked episode
    assert np.array_equal(table.loc[table["attack"] == ATTACKS[1], "attacked"].to_numpy().reshape(episodes, -1)[:, 39:69], np.ones((episodes, 30), bool))


def test_the_innovation_is_the_one_that_the_defence_scores(made: tuple[Path, dict[str, Any]]) -> None:
    """At the first step: what the defence shows of it, and the score of chi2_kf is r' S^-1 r."""
    out, _ = made
    table = pq.read_table(out / "train/thesis-ch4-v0.parquet").to_pandas()
    first = table[table["k"] == 1]
    loop = Cell("s", "thesis-ch4-v0", 30, "chi2_kf", "none", 1).place(tailgate.make_attack("none"), "black").loop(tailgate.make_defence("chi2_kf"))
    state = loop.start(draws.keys("train", range(3)))
    look = loop.defence.look(loop.plan.defence, state.defence, state.received, state.known_u)  # type: ignore[attr-defined]
    r = first[first["attack"] == "none"][["innovation_position", "innovation_velocity"]].to_numpy()
    assert np.array_equal(r, look.innovation.r[:, 0])
    S = look.innovation.S[:, 0]
    assert np.allclose(np.einsum("bi,bij,bj->b", r, np.linalg.inv(S), r), first[first["attack"] == "none"]["score"], rtol=1e-12)


def test_a_defence_without_an_innovation_has_nulls(tmp_path: Path) -> None:
    write_log(SUITE, tmp_path / "log", episodes=1, dev_episodes=1, defences=["none"], attacks=["none"])
    table = pq.read_table(tmp_path / "log/train/thesis-ch4-v0.parquet")
    assert table["innovation_position"].null_count == len(table) > 0 and table["reading_position"].null_count == 0


def test_what_is_held_out_is_in_no_file_and_is_refused_by_name(made: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    out, held = made
    assert held["held_out"] == ["fdi_ramp"] and "fdi_ramp" in (out / "README.md").read_text()
    for path in out.rglob("*.parquet"):
        assert not any("fdi_ramp" in text for text in set(pq.read_table(path)["attack"].to_pylist()))
    with pytest.raises(tailgate.InputError, match=r"fdi_ramp:rate=1.*hold out"):
        write_log(SUITE, tmp_path / "log", attacks=["fdi_ramp:rate=1"])
    assert not (tmp_path / "log").exists()


RAMPS = ("fdi_ramp", "echo_pull_off")
PROGRAM = "phases:\n  - {{kind: fdi, value: 3.0, length: 9}}\n  - {{kind: {kind}, value: {value}, probability: {probability}}}\n"


@pytest.mark.parametrize(
    ("attack", "also"),
    [
        ("program:path=slow_ramp_then_hold", {"fdi_ramp", "dos_hold"}), ("program:path=scattered_bias", {"fdi", "fdi_bernoulli"}),
        ("program:path=sudden_bias", {"fdi"}), ("program:path=burst_jamming", {"dos_jam", "radar_jam"}), ("fdi_sparse:value.name=ramp", {"fdi_ramp"}),
        ("fdi_sparse:value=3", {"fdi", "fdi_bernoulli"}), ("fdi:chance=0.5", {"fdi_bernoulli"}), ("fdi", set()), ("stealth", set()),
        ("zoo:name=platoon-chi2_dkf-0", set(RAMPS)), (str(zoo_path("platoon-chi2_dkf-0")), set(RAMPS)), ("zoo:name=car-following-kf-0", set()),
        (PROGRAM.format(kind="fdi", value="{position: 1.0, velocity: {name: ramp, rate: 0.1}}", probability=1.0), {"fdi", "fdi_ramp"}),
        (PROGRAM.format(kind="fdi", value=2.0, probability="{velocity: 0.2}"), {"fdi", "fdi_bernoulli"}),
        (PROGRAM.format(kind="echo_delay", value="{name: ramp}", probability=1.0), {"fdi", "echo_pull_off"}),
        (PROGRAM.format(kind="noise_jam", value="{name: gaussian}", probability=1.0), {"fdi", "noise_jam"}),
    ],
)  # fmt: skip
def test_an_attack_is_of_every_family_whose_shape_it_has(attack: str, also: set[str], tmp_path: Path) -> None:
    """Kind and law of a program's phases, of a law that a script takes, and of values that a policy changes step by step."""
    if attack.startswith("phases"):
        (tmp_path / "p.yaml").write_text(attack)
        attack = str(tmp_path / "p.yaml")
    assert families(attack) == {Spec("attack", attack).entry.name} | also


@pytest.mark.long
def test_what_is_held_out_is_held_out_under_other_names(tmp_path: Path) -> None:
    """A program with a ramp is refused by name, and left out of the suite's attacks, which the card says."""
    attacks = ("none", "dropout", "program:path=slow_ramp_then_hold")
    suite = dataclasses.replace(SUITE, attacks=attacks)
    with pytest.raises(tailgate.InputError, match=r"slow_ramp_then_hold.*hold out of its logs, as it does fdi_ramp"):
        write_log(suite, tmp_path / "log", attacks=attacks)
    assert not (tmp_path / "log").exists()
    held = write_log(suite, tmp_path / "log", episodes=1, dev_episodes=1)
    assert held["attacks"] == list(attacks[:2]) and held["left_out"] == list(attacks[2:])
    assert "`program:path=slow_ramp_then_hold`" in (tmp_path / "log/README.md").read_text()


@pytest.mark.long
def test_a_policy_that_grows_its_values_is_in_no_log_where_ramps_are_held_out(tmp_path: Path) -> None:
    """The policy of the zoo that the suite of platoons plays; those that choose moments alone are in the logs."""
    suite = dataclasses.replace(load_suite("platoon-v0"), scenarios=("platoon-gusty-v0",))
    growing, choosing = "zoo:name=platoon-chi2_dkf-0", "zoo:name=platoon-dkf-0"
    held = write_log(dataclasses.replace(suite, attacks=(growing, choosing)), tmp_path / "log", episodes=1, dev_episodes=1)
    assert held["attacks"] == ["none", choosing] and held["left_out"] == [growing]


def test_no_seed_is_one_of_a_board() -> None:
    """The keys of training and development episodes are none of those that select, calibrate or report."""
    keys = {purpose: {int(key) for key in draws.keys(purpose, range(500)).key.ravel()} for purpose in draws.PURPOSES}
    assert set(log.SPLITS.values()) == {"train", "tune"}
    for purpose in log.SPLITS.values():
        assert not any(keys[purpose] & keys[other] for other in draws.PURPOSES if other != purpose)


@pytest.mark.long
def test_the_same_log_has_the_same_bytes(made: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice, and with fewer rows in a row group the same table; a whole log is not played again, another one is not overwritten."""
    out, held = made
    assert write_log(SUITE, tmp_path / "again", **OPTIONS) == held and _bytes(tmp_path / "again") == _bytes(out)
    monkeypatch.setattr(log, "GROUP", 160)
    write_log(SUITE, tmp_path / "split", **OPTIONS)
    path = "train/thesis-ch4-v0.parquet"
    assert pq.ParquetFile(tmp_path / "split" / path).num_row_groups == 9 and pq.ParquetFile(out / path).num_row_groups == 3
    assert pq.read_table(tmp_path / "split" / path).equals(pq.read_table(out / path))
    monkeypatch.setattr(log, "steps", None)  # nothing is played
    assert write_log(SUITE, tmp_path / "again", **OPTIONS) == held
    with pytest.raises(tailgate.InputError, match="another one"):
        write_log(SUITE, tmp_path / "again", **(OPTIONS | {"episodes": 4}))
    (tmp_path / "again/mine.txt").write_text("")
    with pytest.raises(tailgate.InputError, match=r"mine\.txt"):
        write_log(SUITE, tmp_path / "again", **OPTIONS)


class Killed(BaseException):
    """Not an Exception: nothing on the way may catch it."""


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.long), 6])
def test_a_log_that_is_killed_anywhere_goes_on(every: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At writes, fsyncs and renames in turn: parts that were finished are kept, and the bytes are those of a log in peace."""
    options = {"episodes": 1, "dev_episodes": 1, "defences": ["chi2_kf"], "attacks": ["dropout"]}
    tables: dict[str, Any] = {}
    table = log._table

    def once(loop: Any, attack: Any, keys: Any, seeds: range) -> Any:  # the files are what is looked at
        name = f"{type(attack).__name__} {keys.key[0, 0]}"
        tables[name] = tables.get(name) or table(loop, attack, keys, seeds)
        return tables[name]

    monkeypatch.setattr(log, "_table", once)
    write_log(SUITE, tmp_path / "whole", **options)
    whole, calls = _bytes(tmp_path / "whole"), 0
    real, played = log._play_part, []
    monkeypatch.setattr(log, "_play_part", lambda part, *rest: (played.append(part.name), real(part, *rest)))
    for at in range(1, 100, every):
        calls = 0

        def step(what: str, path: Path, at: int = at) -> None:
            nonlocal calls
            calls += 1
            if calls == at:
                raise Killed

        out = tmp_path / str(at)
        monkeypatch.setattr(files, "step", step)
        try:
            write_log(SUITE, out, **options)
            break
        except Killed:
            monkeypatch.setattr(files, "step", None)
        kept = {path.name for path in (out / ".parts").glob("[!.]*.parquet")} if (out / ".parts").is_dir() else set()
        played.clear()
        write_log(SUITE, out, **options)
        assert not kept & set(played) and len(played) == 4 - len(kept)
        assert _bytes(out) == whole
    assert at > 25


@pytest.mark.long
def test_a_part_that_the_disk_damaged_is_played_again(made: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def step(what: str, path: Path) -> None:
        if what == "write" and path.name == "README.md":
            raise Killed

    monkeypatch.setattr(files, "step", step)
    with pytest.raises(Killed):
        write_log(SUITE, tmp_path / "log", **OPTIONS)
    monkeypatch.setattr(files, "step", None)
    one, two, three = sorted((tmp_path / "log/.parts").iterdir())[:3]
    one.write_bytes(b"")
    two.write_bytes(two.read_bytes()[:-9])
    three.write_bytes(bytes(900))
    write_log(SUITE, tmp_path / "log", **OPTIONS)
    assert _bytes(tmp_path / "log") == _bytes(made[0])


def test_the_card_and_the_schema_describe_every_column(made: tuple[Path, dict[str, Any]]) -> None:
    """Those of the files, with unit and role; what only labels or the truth know is named so."""
    out, held = made
    assert json.loads((out / "schema.json").read_text()) == held
    described, card = held["scenarios"]["thesis-ch4-v0"]["columns"], (out / "README.md").read_text()
    assert pq.read_schema(out / "dev/thesis-ch4-v0.parquet").names == [column["name"] for column in described]
    for column in described:
        assert f"| {column['name']} | " in card and column["doc"] in card
        assert column["name"].startswith("truth_") == (column["role"] == "truth")
    roles = {column["name"]: column["role"] for column in described}
    assert [name for name, role in roles.items() if role == "label"] == ["attack", "dose", "attacked", "attack_kind"]
    units = {column["name"]: column["unit"] for column in described}
    assert (units["reading_position"], units["innovation_velocity"], units["t"]) == ("m", "m/s", "s")
    for file in held["files"]:
        assert file["sha256"] in card and pq.ParquetFile(out / file["path"]).metadata.num_rows == file["rows"]
    assert "CC0" in card and held["suite"] in card and "nobody's data is in it" in card


def test_the_card_names_recorded_drives() -> None:
    """Their source and licence, that of a file too; nothing is then said to be all simulated."""
    held = {"suite": "s", "about": "", "version": "0", "format": "f", "identity": "i", "held_out": [], "left_out": [], "files": [],
            "defences": ["kf"], "doses": [1], "attacks": ["none"], "skipped": []}  # fmt: skip
    scenario = {"about": "", "dt": 1, "horizon": 1, "agents": 1, "config_hash": "", "columns": []}
    drives = Recorded(traces=("us06",), path=Path("x/own.csv"))
    card = readme(held | {"scenarios": {"r": scenario | {"recordings": recordings_of(drives)}, "s": scenario | {"recordings": recordings_of(None)}}})
    assert all(part in card for part in ("**us06**", "fastsim", "Apache-2.0", "**own.csv**")) and "nobody's data" not in card


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "defence", "attack", "names"),
    [
        ("radar-following-v0", "kf", "noise_jam:start_step=20", {"energy", "probed"}),
        ("platoon-v2v-v0", "kf", "fdi:value=3", {"message_leader_acceleration", "truth_attacked_predecessor_command", "reading_distance"}),
        ("network-weak-v0", "dkf", "fdi:value=5", {"innovation_y1", "estimate_9"}),
    ],
)  # fmt: skip
def test_every_kind_of_plant_has_a_log(tmp_path: Path, scenario: str, defence: str, attack: str, names: set[str]) -> None:
    """Cars that hear each other, a radar and a network: one row per agent, and only what was attacked is labelled."""
    suite = Suite("s", "", (scenario,), (10,), (defence,), (attack,), 1)
    write_log(suite, tmp_path / "log", episodes=1, dev_episodes=1)
    table = pq.read_table(tmp_path / "log/train" / f"{scenario}.parquet")
    missing = names - set(table.column_names)
    assert not missing, table.column_names
    frame = table.to_pandas()
    attacked = frame[frame["attacked"]]
    steps = attacked.groupby("k")["attacked"].sum()
    assert len(steps) == 10 and set(attacked["attack"]) == {attack}
    hits = attacked[[name for name in table.column_names if name.startswith("truth_attacked_")]]
    assert hits.any(axis=1).all() and not frame[~frame["attacked"]][hits.columns].any().any()
    agents = frame["agent"].max() + 1
    assert len(frame) == agents * frame.groupby("attack")["k"].max().sum()


def test_a_pairing_without_meaning_is_named_and_left_out(tmp_path: Path) -> None:
    held = write_log(SUITE, tmp_path / "log", episodes=1, dev_episodes=1, defences=["none"], attacks=["stealth"])
    assert {entry["attack"] for entry in held["skipped"]} == {"stealth"} and "look" in held["skipped"][0]["reason"]
    assert "`stealth`" in (tmp_path / "log/README.md").read_text()


def test_without_pyarrow_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r"tailgate\[log\]"):
        write_log(SUITE, tmp_path / "log")


def test_the_command_writes_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "suite.yaml").write_text("name: mine\n" + "scenarios: [thesis-ch4-v0]\ndefences: [kf]\nattacks: [fdi, dropout]\nheld_out: [dropout]\n")
    arguments = ["log", "--suite", str(tmp_path / "suite.yaml"), "--out", str(tmp_path / "log"), "--episodes", "1", "--dev-episodes", "1", "--dose", "5"]
    assert ran(command, *arguments) == 0
    shown = capsys.readouterr().out
    assert "train/thesis-ch4-v0.parquet" in shown and "held out: dropout" in shown
    assert ran(command, *arguments, "--json") == 0
    held = json.loads(capsys.readouterr().out)
    assert held["doses"] == [5] and held["attacks"] == ["none", "fdi"] and sum(file["rows"] for file in held["files"]) == 600


def test_a_part_whose_names_are_no_text_is_played_again(tmp_path):
    import pyarrow as pa

    from tailgate.evaluation.cells import Cell
    from tailgate.studies.log import _good

    cell = Cell("quick-v0", "gusty-stop-and-go-v0", None, "kf", "none", 1, "train")
    pq.write_table(pa.table({"somename": [1.0]}), tmp_path / "part", store_schema=False)
    (tmp_path / "part").write_bytes((tmp_path / "part").read_bytes().replace(b"somename", b"\xfdomename"))
    with pytest.raises(UnicodeDecodeError):
        pq.ParquetFile(tmp_path / "part")
    assert not _good(tmp_path / "part", cell)
