"""Random numbers by counter: the published generator, and independence from everything that is not in the key."""

import math

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.draws import Draws, Role, keys
from tailgate.engine import elementary

ANSWERS = [  # Random123 known answers of philox4x32-10: counter, key, words
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def _words(text):
    return np.array([[int(w, 16) for w in text.split()]], np.uint32)


def _philox(counter, key):
    """Philox4x32-10 of Salmon et al. (2011) in numpy: counter (M, 4), key (M, 2) as uint64."""
    c, k, mask = counter.copy(), key.copy(), np.uint64(0xFFFFFFFF)
    for _ in range(10):
        low, high = np.uint64(0xD2511F53) * c[:, 0], np.uint64(0xCD9E8D57) * c[:, 2]
        c = np.stack([(high >> 32) ^ c[:, 1] ^ k[:, 0], high & mask, (low >> 32) ^ c[:, 3] ^ k[:, 1], low & mask], axis=1)
        k = (k + np.array([0x9E3779B9, 0xBB67AE85], np.uint64)) & mask
    return c


def _oracle(source, size):
    """Pairs of uniforms (size, B) as the documentation of a Draws states them."""
    out = np.empty((size + 1, len(source.key)))
    for block in range((size + 1) // 2):
        counter = np.zeros((len(source.key), 4), np.uint64)
        counter[:, 0], counter[:, 1], counter[:, 2], counter[:, 3] = source.episode, block, source.step, source.stream << 16
        w = _philox(counter, np.stack([source.key & np.uint64(0xFFFFFFFF), source.key >> np.uint64(32)], axis=1))
        for half in range(2):
            bits = ((w[:, 2 * half] << np.uint64(32)) | w[:, 2 * half + 1]) >> np.uint64(12)
            out[2 * block + half] = (bits.astype(float) + 0.5) * 2.0**-52
    return out


def _draws(seeds, role=Role.SENSOR, step=3, purpose="train", episode=0):
    held = keys(purpose, seeds)
    held = held._replace(episode=held.episode + np.uint32(episode))
    return held.at(role, np.full(len(seeds), step))


@pytest.mark.parametrize("counter, key, words", ANSWERS)
def test_philox_known_answers(counter, key, words):
    """The generator is the published one."""
    given = [np.array([word], np.uint64) for word in (*_words(counter)[0], *_words(key)[0])]
    np.testing.assert_array_equal(np.stack(elementary.philox(*given), axis=1), _words(words))
    np.testing.assert_array_equal(_philox(_words(counter).astype(np.uint64), _words(key).astype(np.uint64)), _words(words))


@pytest.mark.parametrize("size", [1, 2, 5])
def test_uniforms_equal_a_numpy_transcription(size):
    """uniform() is the counter-based generator, bit for bit."""
    source = _draws(range(50), episode=4)
    np.testing.assert_array_equal(source.uniform((size,)), _oracle(source, size)[:size].T)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_normals_are_box_muller_of_the_same_uniforms(size):
    """normal() against the library's logarithm, sine and cosine."""
    source = _draws(range(50))
    u = _oracle(source, size)
    want = np.empty((size, 50))
    for e in range(size):
        radius, turn = np.sqrt(-2.0 * np.log(u[e - e % 2])), 2.0 * np.pi * u[e - e % 2 + 1]
        want[e] = radius * (np.cos(turn) if e % 2 == 0 else np.sin(turn))
    np.testing.assert_allclose(source.normal((size,)), want.T, atol=2e-15 * 10)


@pytest.mark.parametrize(("kind", "pair"), [("normal", elementary.normal_pair), ("uniform", elementary.uniform_pair)])
def test_compiled_draws_equal_their_source(kind, pair, same_bits):
    """Compilation changes no bit of a draw."""
    source = _draws(range(6))
    counters = source.key, source.episode.astype(np.uint64), source.step.astype(np.uint64), np.uint64(source.stream << 16)
    want = [number for block in range(2) for number in pair(*counters, np.uint64(block))][:3]
    assert same_bits(getattr(source, kind)((3,)), np.stack(want, axis=1))


@pytest.mark.parametrize("kind", ["normal", "uniform"])
def test_a_draw_does_not_depend_on_its_companions(kind, same_bits):
    """Batches of 1, 3, 64 and 4096, in any order: one seed, one draw."""
    whole = getattr(_draws(range(4096)), kind)((2, 3))
    for seeds in ([7], [9, 8, 4000], range(64), [4095]):
        assert same_bits(getattr(_draws(seeds), kind)((2, 3)), whole[list(seeds)])


def test_shape_only_arranges_elements(same_bits):
    """(2, 3) and (6,) hold the same numbers, and fewer elements are a prefix of more."""
    source = _draws(range(9))
    assert same_bits(source.normal((2, 3)).reshape(9, 6), source.normal((6,)))
    assert same_bits(source.normal((3,)), source.normal((6,))[:, :3])
    assert source.uniform().shape == (9,)


def test_every_part_of_the_address_gives_other_numbers():
    """Another role, step, episode, seed, purpose, party or tag: no number in common."""
    base = dict(seeds=[1], role=Role.SENSOR, step=3, purpose="train", episode=0)
    others = [{"role": role} for role in Role if role != Role.SENSOR]
    others += [{"purpose": p} for p in draws.PURPOSES if p != "train"]
    others += [{"step": 4}, {"step": 0}, {"step": 2**32 - 1}, {"episode": 1}, {"episode": 2**29 - 1}]
    others += [{"seeds": [2]}, {"seeds": [2**40]}]
    sets = [_draws(**(base | change)).uniform((64,))[0] for change in [{}, *others]] + [_draws(**base).uniform((64,), tag=1)[0]]
    everything = np.concatenate(sets)
    assert len(np.unique(everything)) == len(everything)


def test_the_three_parties_hold_unrelated_keys():
    """World, attack and defence keys of one seed differ, and so do those of the purposes."""
    held = np.concatenate([keys(purpose, range(100)).key for purpose in draws.PURPOSES])
    assert held.shape == (500, 3) and len(np.unique(held)) == 1500
    parties = {role: int(np.flatnonzero(held[0] == keys("train", [0]).at(role, np.zeros(1)).key[0])[0]) for role in Role}
    assert all(parties[r] == (0 if r < 16 else 1 if r < 32 else 2) for r in Role)


def test_role_numbers_are_frozen():
    """A stream's number is part of every published trace."""
    assert {r.name: int(r) for r in Role}.items() >= {
        "PRIOR": 0, "PROCESS": 1, "SENSOR": 2, "MANOEUVRE": 3, "TRAFFIC": 4, "V2V": 5, "ATTACK": 16, "POLICY": 17, "DEFENCE": 32,
    }.items()  # fmt: skip


def test_unknown_purpose():
    """Only the five purposes exist."""
    with pytest.raises(InputError, match=r"purpose: got 'exam'; expected one of train, tune"):
        keys("exam", [0])


def test_moments_of_normals():
    """Mean, variance, skewness, kurtosis and tail of 1e5 normals within five standard errors, and no correlation in a pair."""
    x = _draws(range(50_000)).normal((2,))
    n = x.size
    flat = x.ravel()
    assert abs(flat.mean()) < 5 / math.sqrt(n)
    assert abs(flat.var() - 1) < 5 * math.sqrt(2 / n)
    assert abs(np.mean(flat**3)) < 5 * math.sqrt(15 / n)
    assert abs(np.mean(flat**4) - 3) < 5 * math.sqrt(96 / n)
    tail = math.erfc(2.5 / math.sqrt(2))
    assert abs(np.mean(np.abs(flat) > 2.5) - tail) < 5 * math.sqrt(tail / n)
    assert abs(np.mean(x[:, 0] * x[:, 1])) < 5 / math.sqrt(n / 2)


def test_moments_of_uniforms():
    """Mean, variance and a ten-bin histogram of 1e5 uniforms within five standard errors; the ends are excluded."""
    x = _draws(range(50_000)).uniform((2,)).ravel()
    n = x.size
    assert x.min() > 0.0 and x.max() < 1.0
    assert abs(x.mean() - 0.5) < 5 / math.sqrt(12 * n)
    assert abs(x.var() - 1 / 12) < 5 * math.sqrt(1 / 180 / n)
    counts = np.histogram(x, 10, (0, 1))[0]
    assert np.max(np.abs(counts - n / 10)) < 5 * math.sqrt(n * 0.09)


def test_successive_steps_are_uncorrelated():
    """No correlation between a step and the next, over 1e5 pairs."""
    a, b = (_draws(range(50_000), step=k).normal((2,)).ravel() for k in (1, 2))
    assert abs(np.mean(a * b)) < 5 / math.sqrt(a.size)


def test_swapping_the_defence_or_the_attack_leaves_every_world_draw(short, play, monkeypatch):
    """Comparisons are paired: what the world draws is the same, address by address and bit for bit."""
    log = []
    fill = Draws._numbers

    def spy(self, fill_, shape, tag):
        out = fill(self, fill_, shape, tag)
        log.append((self.stream, tag, shape, self.step.tobytes(), self.key.tobytes(), out.tobytes()))
        return out

    monkeypatch.setattr(Draws, "_numbers", spy)
    seen = []
    for defence, attack in (("kf", "none"), ("stand_still", "none"), ("chi2_kf", "dos_jam")):
        log.clear()
        play(short(), defence, tailgate.make_attack(attack), range(5), terminate=False, plain=True)
        seen.append([entry for entry in log if entry[0] < 16])
    assert len(seen[0]) > 120
    assert seen[0] == seen[1] == seen[2]
