"""Malformed input: the bounded readers, the least input of each fault that was found, and a sample of the campaign."""

import json
import lzma
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save

from tailgate.base import reading
from tailgate.base.errors import InputError
from tailgate.core.schema import read_yaml, scalar
from tailgate.evaluation.rows import read_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from fuzz import campaign, input_of, valid_of, with_commands
from fuzz_readers import readers

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10))


@pytest.mark.parametrize("text", [
    BOMB, "a: &b [*b]", "a: " + "[" * 100 + "]" * 100, "a: 0x" + "f" * 300, "a: 1\na: 2", "a: 2026-11-27", "a: 2026-02-30", "a: !!int x",
    "a: !!int ''", "a: !!bool x", "a: !!map x", "a: !!binary aGVsbG8=", "a: !!set {b, c}", "[a]: 1\n{b: 1}: 2", "a: !!python/object/apply:os.system [id]",
    "a: " + "x" * reading.YAML, "m0: &m0 {x: 1}\n" + "".join(f"m{i}: &m{i} {{<<: [*m{i - 1}, *m{i - 1}]}}\n" for i in range(1, 20)),
])  # fmt: skip
def test_yaml_that_unfolds_nests_or_names_other_kinds_is_refused(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_yaml(path, "config")
    assert caught.value.field == "config"
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_aliases_that_unfold_to_little_are_read(tmp_path):
    (tmp_path / "a.yaml").write_text("a: &one [1, 2]\nb: *one\nc: &two {x: 1}\nd: {<<: *two, y: 2}\n")
    assert read_yaml(tmp_path / "a.yaml", "config") == {"a": [1, 2], "b": [1, 2], "c": {"x": 1}, "d": {"x": 1, "y": 2}}


def test_a_value_of_the_command_line_that_is_no_plain_data_is_its_text():
    for text in ("2026-11-27", "2026-02-30", "[" * 1000, "!!int x", "!!binary aGVsbG8=", "&a [*a]", "1" * 5000):
        assert scalar(text) == text
    assert scalar("[1, 2.5, none]") == [1, 2.5, "none"]


@pytest.mark.parametrize(("text", "words"), [
    ('{"a": 1, "a": 2}', "twice"), ("[" * 100_000, "nested"), ("[" * 70 + "]" * 70, "nested"), ("[NaN]", "NaN"), ("[1e999]", "too large"),
    ("[" + "9" * 400 + "]", "too large"), ('["\\ud800"]', "surrogate"), ("", "Expecting"), ("\ufeff{}", "BOM"),
])  # fmt: skip
def test_json_is_bounded(text, words):
    with pytest.raises(ValueError, match=words):
        reading.parse_json(text)


def test_json_reads_what_it_read():
    text = '{"a": [1, -2.5e-3, 1e300, true, null, "\\u00e9 e999 \\ud83d\\ude00"], "b": {"0": "' + "0" * 400 + '"}}'
    assert reading.parse_json(text) == json.loads(text)
    assert reading.parse_json("[NaN, 1e999]", strict=False)[1] == float("inf")


def test_a_file_is_read_up_to_its_bound(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 1000)
    assert reading.read_bytes(tmp_path / "a", 1000) == b"x" * 1000
    for path in (tmp_path / "a", Path("/dev/zero")):
        with pytest.raises(OSError, match="more than 999"):
            reading.read_bytes(path, 999)
    with pytest.raises(OSError, match="null"):
        reading.read_bytes(Path("a\0b"))


def _packed(piece, count, **options):
    packer = lzma.LZMACompressor(**options)
    return b"".join([*(packer.compress(piece) for _ in range(count)), packer.flush()])


@pytest.mark.parametrize(("content", "words"), [
    (_packed(b"\0" * (1 << 20), 80, preset=0), "line of more"), (lzma.compress(b"x" * 500)[:-9], "truncated"), (b"x", "format"),
    (lzma.compress(b"\xff\n"), "JSON object"), (lzma.compress(b"") + b"x" * 40, "format"), (b"", "truncated"),
])  # fmt: skip
def test_compressed_rows_that_are_bombs_or_damaged_are_refused(tmp_path, content, words):
    path = tmp_path / "rows.jsonl.xz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_rows(path)


def test_lines_that_compress_too_well_are_refused(tmp_path):
    (tmp_path / "a.xz").write_bytes(_packed(b'{"a": 1}\n' * 100_000, 100, preset=0))
    with pytest.raises(OSError, match="do not compress that well"):
        for _ in reading.lines_of(tmp_path / "a.xz"):
            pass


def test_a_compressed_file_that_needs_much_memory_is_refused(tmp_path):
    from fuzz_inputs import _hungry

    plain = lzma.compress(b"a\n", filters=[{"id": lzma.FILTER_LZMA2, "preset": 0, "dict_size": 1 << 23}])
    (tmp_path / "a.xz").write_bytes(_hungry(plain))
    with pytest.raises(lzma.LZMAError, match="emory"):
        list(reading.lines_of(tmp_path / "a.xz"))


def test_every_part_of_a_compressed_file_is_read(tmp_path):
    """Two files one behind the other, as `cat` makes: of them only the first was read, without a word."""
    lines = [b'{"a": %d}\n' % i for i in range(300_000)]
    (tmp_path / "a.xz").write_bytes(lzma.compress(b"".join(lines[:200_000]), preset=0) + b"\0" * 4 + lzma.compress(b"".join(lines[200_000:]), preset=0))
    assert list(reading.lines_of(tmp_path / "a.xz")) == lines


def test_metadata_of_tensors_comes_with_them():
    tensors, about = reading.tensors_of(save({"a": np.ones(3)}, {"facts": "{}"}), load)
    assert tensors["a"].sum() == 3
    assert about == {"facts": "{}"}
    for blob in (b"", b"\0" * 8, b"\xff" * 8, b"\x02\0\0\0\0\0\0\0[]"):
        with pytest.raises(ValueError, match=r"\S"):
            reading.tensors_of(blob, load)


def test_an_error_is_one_line_whatever_it_names():
    text = str(InputError("field\nof \x1b[31m" + "x" * 5000, "a\nb", "one\nline"))
    assert text.isprintable()
    assert len(text) < 500


@pytest.mark.parametrize(("text", "words"), [
    ("t,v\n0,1\x00\n1,1\n", "NUL|numbers"), ('t,v\n0,"' + "x" * 200_000, "field larger"), ("t,v\n0,1\n1e12,1\n", "at most 100000"),
])  # fmt: skip
def test_profiles(tmp_path, text, words):
    from tailgate.envs.manoeuvres import read_profile

    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_profile(tmp_path / "p.csv")


def test_a_list_of_attacks_that_is_no_text_is_refused(tmp_path):
    from tailgate.evaluation.attack_list import read

    (tmp_path / "attacks.jsonl").write_bytes(b"\xff\n")
    with pytest.raises(InputError, match="line 1"):
        read(tmp_path / "attacks.jsonl")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"curve": [1]}', '{"curve": [], "seconds": "x"}', "[" * 100_000])
def test_a_damaged_curve_is_refused(tmp_path, text):
    from tailgate.training.trainings import spent

    (tmp_path / "curve-0.json").write_text(text)
    with pytest.raises(InputError, match="curve"):
        spent(tmp_path / "curve-0.json")


@pytest.mark.thin(8)
@pytest.mark.parametrize("name", ["rows", "training preset", "compressed rows", "policy", "policy's tensors", "card", "speed profile", "formulas"])
def test_a_sample_of_the_campaign_ends_well(name):
    valid = valid_of(name)
    report = campaign(readers()[name], 80, 0, valid=valid)
    assert report["faults"] == {}
    assert report["accepted"] >= len(valid)
    assert report["refused"] > 20


def test_the_campaign_sees_a_fault(tmp_path):
    """Of a reader that reads without a guard."""
    from dataclasses import replace

    import fuzz

    signal.signal(signal.SIGPROF, fuzz._late)
    card, valid = readers()["card"], valid_of("card")
    assert fuzz.met(card, tmp_path, valid[0]) == "accepted"
    assert fuzz.met(card, tmp_path, b"{") == "refused"
    assert "JSONDecodeError" in fuzz.met(replace(card, read=lambda folder: json.loads((folder / "card.json").read_text())), tmp_path, b"{")
    assert fuzz.met(replace(card, read=lambda folder: (folder / "new").touch()), tmp_path, b"{") == "wrote a file"
    assert input_of(card, valid, 0, 7) == input_of(card, valid, 0, 7) != input_of(card, valid, 1, 7)


@pytest.mark.long
@pytest.mark.parametrize("name", list(readers()))
def test_every_reader_meets_more_inputs(name):
    reader, valid = readers()[name], valid_of(name)
    report = with_commands(campaign(reader, 2000, 1, valid=valid), reader, 1, valid, 3)
    assert report["faults"] == {}
    assert report["command_faults"] == {}
