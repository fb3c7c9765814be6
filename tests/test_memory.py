"""A run that would not fit into the memory is refused before it starts."""

import pytest

import train
from aser import build, memory
from aser.errors import ConfigError

GIB = 2**30
PLAIN = {"stored": 5000, "warm_up": 100, "batch": 256, "window": 1, "hidden": (24,), "episodes": 1}


def test_the_estimate_holds_what_a_run_allocates():
    run = build.build(train.settings(["seeds=3", "compile=false"]), train.CONF, train.CONF)
    storage, priorities = run.setup.buffer.storage, run.setup.buffer.priorities
    tensors = [storage.rows, storage.draw_count, storage.unroll_sum, priorities.leaves]
    parts = memory.needed(3, 4, 2, **PLAIN)
    held = sum(tensor.nbytes for tensor in tensors)
    assert held <= parts["buffer"] <= 1.5 * held
    assert sum(parts.values()) == sum(memory.needed(1, 4, 2, **PLAIN).values()) * 3


def test_the_tables_of_a_criterion_count():
    words = ["seeds=3", "compile=false", "sampler=outcome_spread", "criterion.buckets=1000"]
    run = build.build(train.settings([*words, "hyper=thesis"]), train.CONF, train.CONF)
    (own,) = run.state.criteria.values()
    held = own.states.nbytes + own.actions.nbytes
    part = memory.needed(3, 4, 2, **PLAIN, buckets=1000)["criterion.buckets"]
    assert held <= part <= 1.5 * held
    assert memory.needed(3, 4, 2, **PLAIN)["criterion.buckets"] == 0


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["env=pendulum", "steps=1000000", "seeds=4000"], "buffer"),
        (["network.hidden=[300000,300000]"], "network.hidden"),
        (["batch=1000000000"], "batch"),
        (
            ["sampler=outcome_spread", "criterion.buckets=65536", "hyper=thesis", "seeds=9000"],
            "criterion.buckets",
        ),
        (["steps=2000000000", "learning_starts=1000000000", "buffer=10"], "learning_starts"),
    ],
)
def test_what_needs_most_is_named_and_nothing_is_made(words, key, capsys, tmp_path):
    folder = tmp_path / "run"
    assert train.main([*words, f"run_dir={folder}"]) == 1
    message = capsys.readouterr().err
    assert message.startswith(f"train: {key}: ") and message.count("\n") == 1
    assert "GiB are free; allowed: a smaller" in message and not folder.exists()


def test_the_smaller_of_machine_and_control_group_counts(tmp_path, monkeypatch):
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:  4194304 kB\n")
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    assert memory.free() == 4 * GIB
    for name, text in (("max", "3000"), ("current", "2000"), ("stat", "anon 1\ninactive_file 500")):
        (tmp_path / f"memory.{name}").write_text(text)
    assert memory.free() == 1500
    (tmp_path / "memory.max").write_text("max")
    assert memory.free() == 4 * GIB
    (tmp_path / "meminfo").unlink()
    assert memory.free() is None
    memory.check({"buffer": 10**30}, 3)  # where nothing is known, nothing is refused
    monkeypatch.setattr(memory, "free", lambda: 5 * GIB)
    memory.check({"buffer": 4 * GIB, "batch": GIB}, 3)
    with pytest.raises(ConfigError, match="^buffer: 3 lanes need about 5.5 GiB of memory, 4 of"):
        memory.check({"buffer": 4 * GIB, "batch": 3 * GIB // 2}, 3)
