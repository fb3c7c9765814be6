"""Random numbers are a pure function of seed, stream, step and position, and are random enough."""

import math

import pytest
import torch
from scipy import stats

from aser import noise
from aser.compiled import compiled, why_not_compiled
from aser.lanes import batched
from aser.noise import Stream

MASK = 2**32 - 1
LIKELY = 1e-3  # the smallest p-value that passes; all seeds are fixed
needs_compiler = pytest.mark.skipif(
    why_not_compiled() is not None, reason="no C++ compiler or no Python.h"
)
SEEDS = [0, 1, 2, 3, 1000, 2**31 - 1]


# A twin in plain Python, with unbounded integers and one word at a time.


def mix(x):
    x &= MASK
    x = ((x ^ (x >> 16)) * 0x21F0AAAD) & MASK
    x = ((x ^ (x >> 15)) * 0xD35A2D97) & MASK
    return x ^ (x >> 15)


def python_at_step(key, step):
    a, b = (int(k) & MASK for k in key)
    return mix(mix(a + step) + b), mix(mix(b + step) + a)


def python_bits(key, count):
    start, stride = (int(k) & MASK for k in key)
    return [mix(position * (stride | 1) + start) for position in range(count)]


def python_uniform(key, count):
    return [((word >> 9) + 0.5) / 2**23 for word in python_bits(key, count)]


def python_double(key, count):
    return [(word + 0.5) / 2**32 for word in python_bits(key, count)]


def python_normal(key, count):
    half = (count + 1) // 2
    u = python_uniform(key, 2 * half)
    radius = [math.sqrt(-2.0 * math.log(x)) for x in u[:half]]
    angle = [2.0 * math.pi * x for x in u[half:]]
    pair = [r * math.cos(a) for r, a in zip(radius, angle, strict=True)]
    return (pair + [r * math.sin(a) for r, a in zip(radius, angle, strict=True)])[:count]


def int32(word):
    return word - 2**32 if word >= 2**31 else word


def key_of(seed, stream=Stream.ACTION, step=None):
    key = noise.lane_keys([seed])[0, stream]
    return key if step is None else noise.at_step(key, torch.tensor(step, dtype=torch.int32))


STEPS = [0, 1, 5, 2**24 + 1, 2**31 - 2]  # float32 cannot tell 2^24 + 1 from 2^24
SHAPES = {
    "bits": 7,
    "uniform": (3, 5),
    "uniform_double": (7,),
    "normal": (3, 3),
}  # an odd number of normals


def everything(key):
    """Return numbers of every kind of one lane at one step, from one key (2,)."""
    return {name: getattr(noise, name)(key, shape) for name, shape in SHAPES.items()}


@pytest.mark.parametrize(
    "on", [False, pytest.param(True, marks=needs_compiler)], ids=["eager", "compiled"]
)
def test_equals_a_hash_in_plain_python(on):
    """As in training, numbers are mapped over lanes, and then over steps."""
    keys = noise.lane_keys(SEEDS)[:, Stream.PATH]
    at = noise.at_step(keys, torch.tensor(STEPS, dtype=torch.int32)[:, None, None])  # (steps, L, 2)
    drawn = compiled(batched(batched(everything)), on)(at)  # each (steps, L, ...)
    for i, step in enumerate(STEPS):
        for lane, key in enumerate(keys.tolist()):
            mine, key = (
                {name: values[i, lane] for name, values in drawn.items()},
                python_at_step(key, step),
            )
            assert at[i, lane].tolist() == [int32(word) for word in key]
            assert mine["bits"].tolist() == [int32(word) for word in python_bits(key, 7)]
            assert mine["uniform"].flatten().tolist() == python_uniform(key, 15)
            assert mine["uniform_double"].tolist() == python_double(key, 7)
            expected = torch.tensor(python_normal(key, 9)).reshape(3, 3)
            torch.testing.assert_close(mine["normal"], expected, rtol=1e-5, atol=2e-6)
    assert drawn["normal"].dtype == drawn["uniform"].dtype == torch.float32
    assert drawn["uniform_double"].dtype == torch.float64


def test_numbers_gives_each_stream_its_own():
    keys = noise.lane_keys([4, 9])[1]
    wanted = {Stream.DRAW: (noise.uniform_double, (6,)), Stream.POLICY: (noise.normal, (3, 5))}
    drawn = noise.numbers(keys, wanted)
    assert list(drawn) == list(wanted)
    assert drawn[Stream.DRAW].tolist() == python_double(keys[Stream.DRAW].tolist(), 6)
    assert torch.equal(drawn[Stream.POLICY], noise.normal(keys[Stream.POLICY], (3, 5)))


def test_a_prefix_does_not_depend_on_how_much_is_asked_for():
    assert torch.equal(noise.bits(key_of(5), 1000)[:7], noise.bits(key_of(5), 7))


def test_no_two_keys_are_alike():
    """No two lanes, streams or steps have the same key."""
    seeds = [
        *range(3000),
        *(2**31 - 1 - i for i in range(50)),
        *(2**32 + i for i in range(50)),
        2**40,
        2**50,
    ]
    keys = noise.lane_keys(seeds)
    assert keys.shape == (len(seeds), len(Stream), 2) and keys.dtype == torch.int32
    at = noise.at_step(
        noise.lane_keys(range(5)), torch.arange(2000, dtype=torch.int32)[:, None, None, None]
    )
    every = torch.cat([keys.flatten(0, 1), at.flatten(0, 2)]).long()
    assert len((every[:, 0] * 2**32 + every[:, 1]).unique()) == len(every)
    # By chance, one half of the key is shared about n^2 / 2^33 times.
    expected = len(every) ** 2 / 2**33
    assert all(
        abs(len(every) - len(half.unique()) - expected) < 5 * expected**0.5 for half in every.T
    )


# The quality of the numbers. As in a run, lanes have neighbouring seeds and steps are successive.


def at_steps(seeds, steps, streams=tuple(Stream)):
    """Return the keys (steps, seeds, streams, 2)."""
    steps = torch.as_tensor(steps, dtype=torch.int32)[:, None, None, None]
    return noise.at_step(noise.lane_keys(seeds)[:, list(streams)], steps)


def of_keys(draw, keys, *shape):
    """Return the numbers (..., *shape) of keys (..., 2)."""
    drawn = batched(lambda key: draw(key, shape))(keys.reshape(-1, 2))
    return drawn.reshape(*keys.shape[:-1], *shape)


def many(draw, count=4096):
    """Return numbers (keys, count) of neighbouring seeds, all streams and successive steps."""
    return of_keys(draw, at_steps(range(4), [0, 1, 2, 2**20]), count).flatten(0, 2).double()


def words(key, shape):
    return noise.bits(key, *shape)


def test_words_do_not_repeat():
    """Overlapping sequences would repeat thousands of words; chance repeats n^2 / 2^33."""
    drawn = many(words).flatten()
    repeated = len(drawn) - len(drawn.unique())
    expected = len(drawn) ** 2 / 2**33
    assert (
        stats.poisson.cdf(repeated, expected) > LIKELY
        and stats.poisson.sf(repeated, expected) > LIKELY
    )


@pytest.mark.parametrize("draw", [noise.uniform, noise.uniform_double])
def test_uniform_numbers_are_uniform(draw):
    values = many(draw)
    assert values.min() > 0.0 and values.max() < 1.0
    p = [stats.kstest(row.numpy(), "uniform").pvalue for row in values]
    assert stats.kstest(p, "uniform").pvalue > LIKELY, (
        "neither too uneven nor too even, sequence by sequence"
    )
    counts = torch.histc(values, 1000, 0.0, 1.0)
    assert stats.chisquare(counts.numpy()).pvalue > LIKELY
    for order in range(1, 5):
        error = (values**order).mean() - 1 / (order + 1)
        spread = math.sqrt((1 / (2 * order + 1) - 1 / (order + 1) ** 2) / values.numel())
        assert abs(error) < 4 * spread


@pytest.mark.parametrize("word", [0, -1, 2**31 - 1, -(2**31)])
def test_the_interval_is_open(word, monkeypatch):
    """The extreme words occur once in four thousand million draws."""
    monkeypatch.setattr(
        noise, "bits", lambda key, count: torch.full((count,), word, dtype=torch.int32)
    )
    for draw in (noise.uniform, noise.uniform_double):
        value = draw(key_of(0), (3,))
        assert (value > 0).all() and (value < 1).all()
        assert value[0] == pytest.approx((word & MASK) / 2**32, abs=2**-23)
        # A draw from a million items gives one of them.
        assert ((value.double() * 10**6).long() < 10**6).all()
    assert noise.normal(key_of(0), (4,)).isfinite().all()


def test_double_draws_reach_every_item_of_a_million():
    count, items = 2**22, 10**6
    drawn = (noise.uniform_double(key_of(1, Stream.DRAW, 7), (count,)) * items).long()
    # Coarse numbers would favour some remainders.
    last_bits = torch.bincount(drawn % 64, minlength=64)
    assert stats.chisquare(last_bits.numpy()).pvalue > LIKELY
    never = items - len(drawn.unique())
    expected = items * math.exp(-count / items)
    assert abs(never - expected) < 5 * math.sqrt(expected)


def test_normal_numbers_are_normal():
    values = many(noise.normal)
    n = values.numel()
    for order, (mean, variance) in {
        1: (0, 1),
        2: (1, 2),
        3: (0, 15),
        4: (3, 96),
        6: (15, 10170),
    }.items():
        assert abs((values**order).mean() - mean) < 4 * math.sqrt(variance / n)
    p = [stats.kstest(row.numpy(), "norm").pvalue for row in values]
    assert stats.kstest(p, "uniform").pvalue > LIKELY
    edges = stats.norm.ppf(torch.linspace(0, 1, 501)[1:-1].numpy())
    counts = torch.bincount(
        torch.bucketize(values.flatten(), torch.from_numpy(edges)), minlength=500
    )
    assert stats.chisquare(counts.numpy()).pvalue > LIKELY
    assert 4.5 < values.abs().max() < 5.8  # 720,896 numbers


def test_lanes_streams_and_steps_are_independent():
    """Sequences do not correlate, nor do their magnitudes, nor neighbours shifted by one."""
    values = many(noise.normal)
    count = values.shape[1]
    for x in (values, values.abs()):
        x = (x - x.mean(1, keepdim=True)) / x.std(1, correction=0, keepdim=True)
        for other in (x, x.roll(1, 1)):
            r = (x @ other.T / count)[torch.triu_indices(len(x), len(x), 1).unbind()]
            # 15,400 pairs: 4.0 is typical, 5.2 once in 300.
            assert r.abs().max() * math.sqrt(count) < 5.2
            assert stats.kstest(r.numpy() * math.sqrt(count), "norm").pvalue > LIKELY / 10


def test_pairs_fill_the_square_evenly():
    """Neighbours in position, step and seed are independent, and so are Box and Muller pairs."""
    keys = at_steps(range(600), range(50), [Stream.TARGET])[:, :, 0]
    u = of_keys(noise.uniform, keys, 6).double()
    z = 0.5 * torch.erfc(-of_keys(noise.normal, keys, 6).double() / math.sqrt(2)).clamp(
        1e-9, 2 - 1e-9
    )
    for x in (u, z):  # (steps, seeds, 6)
        pairs = [
            (x[..., :-1], x[..., 1:]),
            (x[..., :3], x[..., 3:]),
            (x[:-1], x[1:]),
            (x[:, :-1], x[:, 1:]),
        ]
        for one, two in pairs:
            cell = (one * 16).long() * 16 + (two * 16).long()
            assert (
                stats.chisquare(torch.bincount(cell.flatten(), minlength=256).numpy()).pvalue
                > LIKELY / 2
            )


def test_draws_of_one_step_are_independent_of_each_other():
    """Neighbours within a long sequence are independent, for each key: a bad stride would show."""
    u = (
        of_keys(noise.uniform, at_steps(range(60), [3, 4], [Stream.DRAW, Stream.POLICY]), 8192)
        .flatten(0, 2)
        .double()
    )
    p = []
    for row in u:
        for lag in (1, 2, 3, 128):
            cell = (row[:-lag] * 16).long() * 16 + (row[lag:] * 16).long()
            p.append(stats.chisquare(torch.bincount(cell, minlength=256).numpy()).pvalue)
        cell = ((row[:-2] * 8).long() * 8 + (row[1:-1] * 8).long()) * 8 + (row[2:] * 8).long()
        p.append(stats.chisquare(torch.bincount(cell, minlength=512).numpy()).pvalue)
    assert stats.kstest(p, "uniform").pvalue > LIKELY
    assert min(p) > LIKELY / len(p)


def test_the_first_number_of_each_step_and_of_each_seed_is_random_too():
    """An action needs one or two numbers per step, so numbers must be random over steps."""
    by_step = of_keys(noise.normal, at_steps([0], range(20_000), [Stream.ACTION])[:, 0, 0], 2)
    by_seed = of_keys(noise.normal, at_steps(range(5000), [0], [Stream.ACTION])[0, :, 0], 2)
    for values in (*by_step.T, *by_seed.T):
        assert stats.kstest(values.numpy(), "norm").pvalue > LIKELY
        for lag in (1, 2, 16):
            r = (values[:-lag] * values[lag:]).mean() * math.sqrt(len(values))
            assert abs(r) < 4


def test_each_bit_is_a_fair_coin():
    drawn = many(words, 1024).long()
    for bit in range(32):
        ones = ((drawn >> bit) & 1).sum().item()
        assert stats.binomtest(ones, drawn.numel()).pvalue > LIKELY / 10
    # The next step changes half of the bits.
    following = of_keys(words, at_steps([2], range(2000), [Stream.INIT]), 3).long() & MASK
    changed = sum(
        (((following[1:] ^ following[:-1]) >> bit) & 1).double().mean() for bit in range(32)
    )
    assert abs(changed - 16) < 0.2


# The hash of states.


def python_hash_columns(key, x):
    words = x.float().view(torch.int32).tolist()
    codes = []
    for column in zip(*words, strict=True):
        code = mix((column[0] & MASK) + (key[0] & MASK))
        for word in column[1:]:
            code = mix(code + (word & MASK))
        codes.append(int32(mix(code + (key[1] & MASK))))
    return codes


@pytest.mark.parametrize(
    "on", [False, pytest.param(True, marks=needs_compiler)], ids=["eager", "compiled"]
)
def test_hash_columns_equals_plain_python(on):
    keys = noise.lane_keys([3, 8, 9])[:, Stream.SHUFFLE]
    x = torch.randn(3, 4, 5, generator=torch.Generator().manual_seed(0))  # (L, O, B)
    drawn = compiled(batched(noise.hash_columns), on)(keys, x)
    assert drawn.tolist() == [
        python_hash_columns(k, c) for k, c in zip(keys.tolist(), x, strict=True)
    ]


def test_hash_columns_knows_values_only():
    key = key_of(6, Stream.SHUFFLE)
    x = torch.tensor([[0.5, 0.5, 0.25, 0.5], [-0.25, -0.25, 0.5, -0.25], [0.0, -0.0, 0.0, 1e-45]])
    code = noise.hash_columns(key, x)
    assert code[0] == code[1], "-0.0 is 0.0"
    assert len(set(code.tolist())) == 3, "the order of the values and the smallest change count"
    assert torch.equal(noise.hash_columns(key, x.double()), code)
    assert (noise.hash_columns(key_of(7, Stream.SHUFFLE), x) != code).all()


def test_hash_columns_spreads_a_grid_evenly():
    x = torch.cartesian_prod(torch.linspace(-1, 1, 60), torch.linspace(-1, 1, 50)).T
    for seed in range(4):
        chosen = (noise.hash_columns(key_of(seed, Stream.SHUFFLE), x) & 0x7FFFFFFF) % 100
        assert stats.chisquare(torch.bincount(chosen, minlength=100).numpy()).pvalue > LIKELY
