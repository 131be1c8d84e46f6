"""The loop of all trainings: what it logs, when it saves, and that it stops at a signal and resumes."""

import os
import signal

import pytest
import torch
from torch import nn

from tests.refusals import refused
from torchrl_sparse.training.curves import read_scalars
from torchrl_sparse.training.loop import train
from torchrl_sparse.training.trainer import Trainer


class Config:
    batch_size, max_grad_norm, seed = 2, 0.0, 0


class Regression(Trainer):
    """Fits one number to eight samples; `at_step` is called before each step."""

    def __init__(self, total=6, at_step=lambda step: None, scale=3):
        self.scale = scale
        module = nn.Linear(1, 1, bias=False)
        nn.init.zeros_(module.weight)
        self.samples, self.at_step = torch.arange(8.0)[:, None], at_step
        optimizer = torch.optim.SGD(module.parameters(), lr=0.01)
        super().__init__(module, optimizer, Config, num_samples=8, total=total, warmup_steps=0)

    def batch_losses(self, index):
        self.at_step(self.step)
        error = self.module(self.samples[index]) - self.scale * self.samples[index]
        return {"loss": error.square().mean(), "bias": error.mean()}

    def validate(self):
        return {"error": abs(self.module.weight.item() - 3)}

    def header(self):
        return {"config": {"max_steps": self.total, "scale": self.scale}}


@pytest.fixture
def run(tmp_path):
    def run(trainer, evaluate=None):
        settings = {"out": tmp_path, "logger": "csv"}
        settings |= {"log_every": 2, "checkpoint_every": 3, "eval_every": 4}
        saved = []

        def export():
            assert (tmp_path / "checkpoint.pt").exists()
            saved.append(trainer.step)
            return tmp_path / "planner"

        train(trainer, settings, export=export, evaluate=evaluate)
        return saved

    return run


def test_metrics_are_logged_checkpoints_written_and_policies_evaluated(run, tmp_path, capsys):
    plain = Regression()
    losses = [plain.train_step() for _ in range(6)]
    assert run(Regression(), evaluate=lambda: 0.5) == [3, 6, 6]
    logged = read_scalars(tmp_path / "log")
    means = [(losses[i]["bias"] + losses[i + 1]["bias"]) / 2 for i in (0, 2, 4)]
    assert logged["train/bias"][:, 0].tolist() == [2, 4, 6]
    assert logged["train/bias"][:, 1].tolist() == pytest.approx(means)
    assert logged["train/lr"][-1, 1] == pytest.approx(plain.lr)
    assert (logged["train/seconds_per_step"][:, 1] > 0).all()
    assert logged["held_out/error"][:, 0].tolist() == [3, 6]
    assert logged["eval/success"].tolist() == [[4, 0.5]]
    assert "planner: step 6 of 6, finished" in capsys.readouterr().out


def test_a_signal_ends_the_step_saves_and_leaves_ctrl_c_as_it_was(run, capsys):
    trainer = Regression(at_step=lambda step: step == 3 and os.kill(os.getpid(), signal.SIGTERM))
    assert run(trainer)[-1] == trainer.step == 4
    assert "step 4 of 6, stopped by SIGTERM, run again to resume" in capsys.readouterr().out
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    resumed, unbroken = Regression(), Regression()
    run(resumed)
    assert "checkpoint.pt: resumed from step 4" in capsys.readouterr().out
    for _ in range(6):
        unbroken.train_step()
    assert torch.equal(resumed.module.weight, unbroken.module.weight)


@pytest.mark.parametrize("stop_in", [2, 3])
def test_an_entry_of_the_log_is_the_mean_of_all_its_steps_after_a_stop_between_entries(
    run, tmp_path, stop_in
):
    plain = Regression()
    losses = [plain.train_step()["loss"] for _ in range(6)]
    run(Regression(at_step=lambda step: step == stop_in and os.kill(os.getpid(), signal.SIGTERM)))
    run(Regression())
    means = [(losses[i] + losses[i + 1]) / 2 for i in (0, 2, 4)]
    assert read_scalars(tmp_path / "log")["train/loss"][:, 1].tolist() == pytest.approx(means)


def test_a_checkpoint_from_before_it_held_unlogged_steps_is_resumed(tmp_path):
    trainer, resumed = Regression(), Regression()
    trainer.train_step()
    torch.save(
        {name: value for name, value in (trainer.header() | trainer.state()).items() if name != "unlogged"},
        tmp_path / "checkpoint.pt",
    )
    resumed.load(tmp_path / "checkpoint.pt")
    assert (resumed.step, resumed.unlogged) == (1, [])


def test_a_checkpoint_of_another_training_is_refused(run):
    run(Regression())
    with refused("checkpoint.pt"):
        run(Regression(total=7, scale=2))


def test_a_longer_training_extends_a_shorter_one_and_none_is_cut_short(run, tmp_path):
    run(Regression())
    longer = Regression(total=8)
    assert run(longer)[-1] == longer.step == 8
    assert read_scalars(tmp_path / "log")["train/lr"][:, 0].tolist() == [2, 4, 6, 8]
    assert longer.lr == 0
    with refused("checkpoint.pt"):
        run(Regression(total=7))


def test_a_csv_log_has_each_step_once_after_a_kill(run, tmp_path):
    def die(step):
        if step == 5:
            raise KeyboardInterrupt  # as a kill, nothing is saved

    with pytest.raises(KeyboardInterrupt):
        run(Regression(at_step=die))
    logs = tmp_path / "log" / "scalars"
    with open(logs / "train" / "loss.csv", "ab") as file:
        file.write(b"4,0.5")  # the kill cut a line off
    assert run(Regression())
    rows = {
        path.stem: [int(line.split(",")[0]) for line in path.read_text().splitlines()]
        for path in logs.rglob("*.csv")
    }
    assert rows == {
        "loss": [2, 4, 6],
        "bias": [2, 4, 6],
        "lr": [2, 4, 6],
        "seconds_per_step": [2, 4, 6],
        "error": [3, 6],
    }


@pytest.mark.parametrize("line", [b"two,3\n", b"\xff\xfe,1\n"])
def test_a_log_that_is_none_is_named(run, tmp_path, line):
    (tmp_path / "log" / "scalars").mkdir(parents=True)
    (tmp_path / "log" / "scalars" / "loss.csv").write_bytes(line)
    with refused("loss.csv"):
        run(Regression())
