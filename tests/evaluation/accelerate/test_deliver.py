"""What is handed over: the saved folder answers as the method that was measured, and card and report say which it is."""

from dataclasses import replace

import pytest
import torch

from tests.evaluation.accelerate.small import fixed_times
from tests.policies.diffusion.test_policy import request as ask_policy
from torchrl_sparse import DiffusionPolicy, keys
from torchrl_sparse.evaluation.accelerate import run, save_policy, write_acceleration_report


@pytest.mark.parametrize(
    ("method", "full"), [("ddpm2_logsnr", True), ("uniform2_ddpm4", False), ("bac2", True)]
)
def test_the_saved_folder_answers_as_the_chosen_method(go, policy, tmp_path, monkeypatch, method, full):
    # A stand-in for the clock, by which any method could be slower than dense and no choice.
    monkeypatch.setattr(run, "time_queries", fixed_times({"dense": 100.0}))
    if full:  # weights that fp16 cannot hold, as of a checkpoint in full precision
        with torch.no_grad():
            policy.network.pos_emb.mul_(1 + 2**-20)
    found, methods = go()
    save_policy(replace(found, chosen=method), methods[method], tmp_path / "fast", n_action_steps=4)
    loaded = DiffusionPolicy.from_pretrained(tmp_path / "fast", engine="reference")
    assert loaded.sampler.config == methods[method].sampler.config
    ours, theirs = methods[method](ask_policy(3)), loaded(ask_policy(3))
    for key in (keys.PRUNE_MASK, keys.CHUNK):
        assert torch.equal(ours[key], theirs[key])
    assert method in (tmp_path / "fast" / "README.md").read_text()


def test_a_folder_is_replaced_whole(go, tmp_path, monkeypatch):
    found, methods = go()
    names = ["bac2", "ddim4"]  # whichever of them this machine found to be faster than dense
    cached, dense = (replace(found, ranking=names, chosen=name) for name in names)
    save_policy(cached, methods["bac2"], tmp_path / "fast", n_action_steps=4)
    monkeypatch.setattr("torchrl_sparse.evaluation.accelerate.deliver.plot_acceleration", broken)
    with pytest.raises(OSError, match="no space"):
        save_policy(dense, methods["ddim4"], tmp_path / "fast", n_action_steps=4)
    assert "plan.json" in {file.name for file in (tmp_path / "fast").iterdir()}
    monkeypatch.undo()
    save_policy(dense, methods["ddim4"], tmp_path / "fast", n_action_steps=4)
    assert "plan.json" not in {file.name for file in (tmp_path / "fast").iterdir()}


def broken(*_):
    raise OSError("no space")


def test_card_and_report_say_that_no_episode_was_played(go, tmp_path):
    found, methods = go()
    save_policy(found, methods[found.chosen], tmp_path / "policy", n_action_steps=4)
    said = "Chosen offline, by the error to demonstrations alone: no episode was played."
    card = (tmp_path / "policy" / "README.md").read_text()
    report = write_acceleration_report(found, tmp_path).read_text()
    assert said in card
    assert said in report
    assert report.count("<img") == 1  # the front, drawn once though the card's own lies below
    assert f'from_pretrained("{tmp_path}/policy")' in card
