"""Signals before and after learning, and numbers of threads that no machine has."""

import os
import signal

import pytest

from sb3_chac.zoo.stopping import check_threads, known_options, one_sentence


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_outside_of_learning_ends_with_one_sentence(number, capsys):
    before = signal.getsignal(signal.SIGTERM)
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(SystemExit) as ended, one_sentence("rl_zoo3 train"):
            os.kill(os.getpid(), number)
            signal.sigtimedwait([], 0)  # a place where Python runs the handler
    finally:
        signal.signal(signal.SIGINT, ours)
    assert ended.value.code == 128 + number
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and number.name in printed
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_others_answer_is_left_to_them(capsys):
    with one_sentence("rl_zoo3 train"):
        with pytest.raises(KeyboardInterrupt):
            raise KeyboardInterrupt  # RL-Zoo3 does so, and saves the model
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("value", ["0", "-2", "99999999", "9" * 400])
def test_absurd_numbers_of_threads(value):
    with pytest.raises(ValueError, match=r"^--num-threads must be") as error:
        check_threads(value)
    assert len(str(error.value)) < 150


@pytest.mark.parametrize("value", ["-1", "1", "8", "many"])
def test_other_numbers_of_threads(value):
    check_threads(value)  # RL-Zoo3's own parser says what is no number


def test_options_are_read_as_rl_zoo3_does():
    assert known_options(["--algo", "chac", "-n", "3", "--num-threads=7"]).num_threads == "7"
    assert known_options(["--algo"]).algo == "ppo"
