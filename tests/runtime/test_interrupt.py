"""Signals within and after a block: the first is noted, the second and those after the block do what they always did."""

import os
import signal

import pytest

from torchrl_sparse.runtime.interrupt import StopSignal

SIGNALS = [signal.SIGINT, signal.SIGTERM]


def send(number):
    os.kill(os.getpid(), number)


@pytest.fixture
def caught():
    """The signals that reach handlers of ours, which stand for the program's own."""
    arrived = []
    before = {
        number: signal.signal(number, lambda number, frame: arrived.append(number)) for number in SIGNALS
    }
    yield arrived
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_is_noted_and_the_second_goes_through(caught, number):
    with StopSignal() as stop:
        assert stop.name is None
        send(number)
        assert stop.name == number.name
        assert caught == []
        send(number)
        assert caught == [number]


@pytest.mark.parametrize("number", SIGNALS)
def test_after_the_block_signals_reach_the_program_again(caught, number):
    with StopSignal():
        pass
    send(number)
    assert caught == [number]


def test_ctrl_c_after_a_block_that_raised_interrupts():
    before = [signal.getsignal(number) for number in SIGNALS]
    with pytest.raises(FloatingPointError), StopSignal():
        raise FloatingPointError
    assert [signal.getsignal(number) for number in SIGNALS] == before
    with pytest.raises(KeyboardInterrupt):
        send(signal.SIGINT)
