import time
from datetime import datetime

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.evaluation.latency.measure import (
    describe_machine,
    measure_latency,
    summarize_latency,
)
from torchrl_sparse.runtime.threads import num_threads


def test_rounds_are_interleaved_and_shuffled():
    calls = []
    names = ["a", "b", "c"]
    measure_latency({name: lambda name=name: calls.append(name) for name in names}, repeats=20, warmup=2)
    rounds = [tuple(calls[start : start + 3]) for start in range(0, len(calls), 3)]
    assert len(rounds) == 22
    assert all(sorted(order) == names for order in rounds)
    assert len(set(rounds)) > 2


def test_order_is_fixed_by_the_seed():
    def order(seed):
        calls = []
        measure_latency(
            {name: lambda name=name: calls.append(name) for name in "abcd"}, repeats=8, warmup=0, seed=seed
        )
        return calls

    assert order(1) == order(1) != order(2)


def test_measures_seconds_and_leaves_warmup_out():
    delays = iter([0.05] + [0.002] * 5)
    result = measure_latency({"sleep": lambda: time.sleep(next(delays))}, repeats=5, warmup=1)
    latency = result["sleep"]
    assert latency.n == len(latency.samples) == 5
    assert 0.002 <= latency.p50 <= latency.p95 < 0.05


def test_inputs_are_made_in_order_and_before_the_clock_starts():
    taken = []

    def slowly():
        for number in range(5):
            time.sleep(0.02)
            yield number

    result = measure_latency(
        {"take": taken.append, "nothing": lambda: None}, repeats=4, warmup=1, inputs={"take": slowly()}
    )
    assert taken == [0, 1, 2, 3, 4]
    assert result["take"].p50 < 0.02


def test_threads_are_set_and_restored_even_after_a_fault():
    before = torch.get_num_threads()
    seen = []
    measure_latency(
        {"look": lambda: seen.append(torch.get_num_threads())}, repeats=1, warmup=0, threads=before + 1
    )
    assert seen == [before + 1]

    def fail():
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        measure_latency({"fail": fail}, threads=before + 1)
    assert torch.get_num_threads() == before


def test_no_gradients_while_measuring():
    seen = []
    measure_latency({"look": lambda: seen.append(torch.is_grad_enabled())}, repeats=1, warmup=0)
    assert seen == [False]


def test_progress():
    seen = []
    measure_latency({"a": lambda: None}, repeats=3, warmup=2, on_round=lambda *args: seen.append(args))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_percentiles():
    latency = summarize_latency([float(i) for i in range(101)])
    assert (latency.p50, latency.p95, latency.n) == (50.0, 95.0, 101)


def test_machine_description():
    machine = describe_machine()
    assert machine.cpu
    assert machine.threads == torch.get_num_threads()
    assert machine.device == "cpu"
    assert machine.torch == torch.__version__
    assert datetime.fromisoformat(machine.date).tzinfo is not None
    assert describe_machine(threads=7).threads == 7


@pytest.mark.parametrize(
    ("call", "entry"),
    [
        (lambda: measure_latency({}), "calls"),
        (lambda: measure_latency({"a": lambda: None}, repeats=0), "repeats, warmup"),
        (lambda: measure_latency({"a": lambda: None}, threads=0), "threads"),
        (lambda: summarize_latency([]), "latencies"),
        (lambda: summarize_latency([float("nan")]), "latencies"),
    ],
)
def test_faults(call, entry):
    with refused(entry):
        call()


def test_num_threads_none_changes_nothing():
    before = torch.get_num_threads()
    with num_threads(None):
        assert torch.get_num_threads() == before
