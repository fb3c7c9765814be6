"""The C++ operators against plain torch, at different sizes and at the borders of blocks."""

import sys

import pytest
import torch

from aser import compiled as compiling
from aser import lanes, native, trees
from aser.agents import networks
from aser.agents.networks import Layer
from aser.replay import bootstrap, moments

library = sys.modules["aser.native.library"]  # the module; `native.library` is its function
pytestmark = pytest.mark.skipif(native.library() is None, reason="nothing can be compiled here")

SIZES = [  # lanes, copies, inputs, hidden, outputs, columns
    (3, (), 4, 24, 4, 37),
    (2, (2,), 6, 7, 1, 16),
    (5, (), 1, 64, 8, 1),
    (1, (3, 2), 32, 5, 2, 33),
    (4, (), 3, 1, 7, 256),
]


def layers_and_columns(size, scale=1.0):
    count, copies, inputs, hidden, outputs, columns = size
    torch.manual_seed(sum(map(hash, size[2:])))
    first = Layer(torch.randn(count, *copies, hidden, inputs), torch.randn(count, *copies, hidden))
    second = Layer(
        torch.randn(count, *copies, outputs, hidden), torch.randn(count, *copies, outputs)
    )
    return [first, second], scale * torch.randn(count, inputs, columns)


def plain(layers, x):
    (w1, b1), (w2, b2) = layers
    return w2 @ torch.relu(w1 @ x + b1[..., None]) + b2[..., None]


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_network_equals_two_matmuls(size):
    layers, x = layers_and_columns(size)
    assert native.fits(layers, x)
    double = [Layer(*(part.double() for part in layer)) for layer in layers]
    expected = torch.func.vmap(plain)(double, x.double())
    torch.testing.assert_close(
        torch.func.vmap(networks.mlp)(layers, x), expected.float(), rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("compiled", [False, True])
def test_gradients_equal_autograds_of_two_matmuls(size, compiled):
    layers, x = layers_and_columns(size)

    def gradients(network, layers, x):
        return torch.func.grad(lambda layers, x: network(layers, x).sin().sum(), argnums=(0, 1))(
            layers, x
        )

    mine = compiling.compiled(
        lanes.batched(lambda layers, x: gradients(networks.mlp, layers, x)), compiled
    )(layers, x)
    double = [Layer(*(part.double() for part in layer)) for layer in layers]
    expected = lanes.batched(lambda layers, x: gradients(plain, layers, x))(double, x.double())
    for (w, b), (v, c) in zip(mine[0], expected[0], strict=True):
        torch.testing.assert_close(w, v.float(), rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(b, c.float(), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(mine[1], expected[1].float(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("count", "dims", "actions", "points", "hidden", "columns"),
    [(3, 4, 2, 16, 24, 37), (2, 1, 1, 5, 64, 16), (1, 7, 3, 1, 9, 1), (5, 3, 2, 21, 1, 70)],
)
@pytest.mark.parametrize("compiled", [False, True])
def test_a_grid_of_actions_is_each_action_by_itself(
    count, dims, actions, points, hidden, columns, compiled
):
    critics, obs = layers_and_columns((count, (2,), dims + actions, hidden, 1, columns))
    obs, grid = obs[:, :dims], torch.rand(actions, points) * 2 - 1

    def each(critics, obs):
        rows = [
            plain(critics, torch.cat([obs, a[:, None].expand(-1, columns)]))
            for a in grid.double().T
        ]
        return torch.stack(rows).squeeze(2).amin(1)  # (points, B)

    double = [Layer(*(part.double() for part in layer)) for layer in critics]
    expected = torch.func.vmap(each)(double, obs.double())
    mine = compiling.compiled(
        lanes.batched(lambda critics, obs: networks.q_grid(critics, obs, grid)), compiled
    )
    torch.testing.assert_close(mine(critics, obs), expected.float(), rtol=1e-4, atol=1e-4)


def test_a_grid_keeps_a_nan_of_either_critic():
    critics, obs = layers_and_columns((1, (2,), 3, 4, 1, 5))
    for critic in (0, 1):
        broken = [Layer(*(part[0].clone() for part in layer)) for layer in critics]
        broken[1].bias[critic] = torch.nan
        assert networks.q_grid(broken, obs[0, :2], torch.zeros(1, 3)).isnan().all()


def test_a_unit_at_exactly_zero_has_torchs_gradient():
    w1, b1 = torch.tensor([[[1.0]]]), torch.tensor([[-2.0]])
    w2, b2, x = torch.tensor([[[3.0]]]), torch.tensor([[0.5]]), torch.tensor([[[2.0, 2.5]]])
    layers = [Layer(w1, b1), Layer(w2, b2)]
    loss = torch.func.grad(lambda x: networks.mlp(layers, x).sum())
    assert networks.mlp(layers, x).tolist() == [[[0.5, 2.0]]]
    assert loss(x).tolist() == [[[0.0, 3.0]]]


def test_weights_shared_by_all_lanes_and_columns_shared_by_all_lanes():
    layers, x = layers_and_columns((3, (), 4, 24, 4, 37))
    one = trees.take(layers, 1)
    result = torch.func.vmap(networks.mlp, (None, 0))(one, x)
    torch.testing.assert_close(
        result, torch.stack([plain(one, lane) for lane in x]), rtol=1e-4, atol=1e-4
    )
    result = torch.func.vmap(networks.mlp, (0, None))(layers, x[0])
    torch.testing.assert_close(result, plain(layers, x[:1]), rtol=1e-4, atol=1e-4)


def test_a_lane_is_the_same_to_the_bit_alone_and_among_others():
    layers, x = layers_and_columns((5, (2,), 6, 24, 1, 250))
    many = torch.func.vmap(networks.mlp)(layers, x)
    for lane in range(5):
        assert torch.equal(networks.mlp(trees.take(layers, lane), x[lane]), many[lane])


def test_a_number_that_is_none_stays_in_its_lane_and_is_seen():
    layers, x = layers_and_columns((3, (), 4, 24, 2, 40))
    layers[0].weight[1, 5, 2] = torch.nan
    result = networks.mlp(layers, x)
    assert result[1].isnan().all() and result[[0, 2]].isfinite().all()


@pytest.mark.parametrize(
    ("hidden", "outputs", "dtype"),
    [([65], 1, torch.float32), ([24], 9, torch.float32), ([24], 1, torch.float64)],
)
def test_other_sizes_and_types_are_left_to_torch(hidden, outputs, dtype):
    layers, x = layers_and_columns((2, (), 4, hidden[0], outputs, 5))
    layers = [Layer(*(part.to(dtype) for part in layer)) for layer in layers]
    assert not native.fits(layers, x.to(dtype))
    torch.testing.assert_close(networks.mlp(layers, x.to(dtype)), plain(layers, x.to(dtype)))


@pytest.mark.parametrize("width", [1, 2, 37])
def test_neighbours_are_what_a_sort_gives(width):
    torch.manual_seed(width)
    x = torch.randn(50, width).round(decimals=1)
    x[::7] = torch.inf
    rank = torch.randint(0, width, (50,))
    before = x.clone()
    result = native.neighbours(x, rank)
    ordered = x.sort(1).values
    assert torch.equal(x, before)
    assert torch.equal(result[:, 0], ordered.gather(1, rank[:, None])[:, 0])
    assert torch.equal(
        result[:, 1], ordered.gather(1, (rank[:, None] + 1).clamp(max=width - 1))[:, 0]
    )
    assert torch.equal(torch.func.vmap(native.neighbours)(x, rank), result)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_quantile_is_the_same_without_our_operator(compiled, monkeypatch):
    torch.manual_seed(3)
    values, valid, k = torch.randn(6, 41), torch.rand(6, 41) < 0.7, torch.linspace(0, 1, 6)
    valid[2] = False
    mine = compiling.compiled(lanes.batched(bootstrap.quantile), compiled)(values, valid, k)
    monkeypatch.setattr(native, "library", lambda: None)
    assert torch.equal(lanes.batched(bootstrap.quantile)(values, valid, k), mine)


@pytest.mark.parametrize(
    ("places", "count", "sizes"), [(7, 41, [3]), (5, 1, [1, 2]), (1, 30, [4, 1, 2]), (64, 16, [8])]
)
@pytest.mark.parametrize("compiled", [False, True])
def test_moments_are_the_same_without_our_operator(places, count, sizes, compiled, monkeypatch):
    torch.manual_seed(places)
    place = torch.randint(places, (2, 6, count))
    outcomes = 2 * torch.randn(2, 6, sum(sizes), count) + torch.arange(6.0)[:, None, None]

    @lanes.batched
    def many(table, place, x):
        table = table.clone()
        moments.observe(table, place, x, sizes, 0.2)
        return table

    mine = compiling.compiled(many, compiled)
    first = torch.zeros(6, places, 1 + sum(sizes) + len(sizes))
    second = mine(first, place[0], outcomes[0])
    third = mine(second, place[1], outcomes[1])
    assert first.count_nonzero() == 0 and third[..., 0].sum(1).tolist() == [2 * count] * 6
    monkeypatch.setattr(native, "library", lambda: None)
    for before, after, i in ((first, second, 0), (second, third, 1)):
        expected = many(before, place[i], outcomes[i])
        torch.testing.assert_close(after, expected, rtol=1e-4, atol=1e-4)


def test_moments_of_places_and_outcomes_shared_by_all_lanes():
    torch.manual_seed(8)
    tables, place = torch.rand(3, 5, 1 + 2 + 1), torch.randint(5, (9,))
    outcomes = torch.randn(4, 2, 9)
    one = [native.observe(table, place, outcomes[0], [2], 0.3) for table in tables]
    shared = torch.func.vmap(lambda t: native.observe(t, place, outcomes[0], [2], 0.3))(tables)
    assert shared.equal(torch.stack(one))
    # Of one table and lanes of outcomes that lie the other way round in memory.
    turned = outcomes.transpose(1, 2).contiguous().transpose(1, 2)
    each = [native.observe(tables[0], place, x, [2], 0.3) for x in outcomes]
    many = torch.func.vmap(lambda x: native.observe(tables[0], place, x, [2], 0.3))(turned)
    assert many.equal(torch.stack(each))
    # And of outcomes whose lanes are not the first dimension.
    last = torch.func.vmap(lambda x: native.observe(tables[0], place, x, [2], 0.3), 2)
    assert last(outcomes.movedim(0, 2).contiguous()).equal(many)


def test_moments_in_float64_are_left_to_torch():
    table, outcomes = torch.zeros(4, 3).double(), torch.tensor([[1.0, 2.0, 4.0]]).double()
    assert not native.serves(table)
    moments.observe(table, torch.tensor([1, 3, 1]), outcomes, [1], 0.25)
    assert table.tolist() == [[0, 0, 0], [2, 1.75, 9 * 0.75 * 0.25], [0, 0, 0], [1, 2, 0]]


def test_a_compiler_that_fails_leaves_plain_torch(monkeypatch, capsys):
    def fails(source):
        raise RuntimeError("no such option")

    from torch._inductor.codecache import CppCodeCache

    monkeypatch.setattr(CppCodeCache, "load", fails)
    native.library.cache_clear()
    try:
        layers, x = layers_and_columns(SIZES[0])
        assert not native.fits(layers, x)
        torch.testing.assert_close(networks.mlp(layers, x), plain(layers, x))
        assert "operators.cpp was not compiled (RuntimeError)" in capsys.readouterr().out
    finally:
        native.library.cache_clear()


def test_a_processor_without_avx_512_gives_the_same(tmp_path, monkeypatch):
    source = library.SOURCE.read_text()
    assert source.count("defined(__AVX512F__)") == 1
    narrower = source.replace("defined(__AVX512F__)", "0")
    (tmp_path / "operators.cpp").write_text(narrower)
    layers, x = layers_and_columns(SIZES[0])
    usual = torch.func.vmap(networks.mlp)(layers, x)
    monkeypatch.setattr(library, "SOURCE", tmp_path / "operators.cpp")
    native.library.cache_clear()
    try:
        for size in SIZES:
            test_network_equals_two_matmuls(size)
            test_gradients_equal_autograds_of_two_matmuls(size, compiled=False)
        assert torch.equal(torch.func.vmap(networks.mlp)(layers, x), usual)
    finally:
        native.library.cache_clear()
