"""Frames that the policy call before has encoded: they are not encoded again, and the features stay what they were."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import ChunkExecutor, keys

CAMERAS, STEPS = ("image", "wrist_image"), 9


@pytest.fixture
def counted(make_image_policy, monkeypatch):
    """A policy, and the frames of a camera that it was given in each policy call."""
    policy = make_image_policy()
    pixels, seen = policy.vision.encoders["image"].pixels, []
    monkeypatch.setattr(policy.vision.encoders["image"], "pixels", lambda x: seen.append(len(x)) or pixels(x))
    policy.vision.register_forward_hook(lambda *_: None)  # not packed: its own layers are called
    return policy, seen


def history(step, batch):
    """What an environment shows in a step: the first frame is repeated."""
    rows = [max(step - 1, 0), step]
    generator = torch.Generator().manual_seed(0)
    frames = {
        name: torch.randint(256, (STEPS, batch, 3, 40, 44), generator=generator).to(torch.uint8)
        for name in CAMERAS
    }
    td = TensorDict(
        {"state": torch.zeros(batch, 2, 3), **{n: f[rows].transpose(0, 1) for n, f in frames.items()}}
    )
    return TensorDict({"history": td, "is_init": torch.full((batch, 1), step == 0)}, [batch])


@pytest.mark.parametrize("n_action_steps", [1, 2])
def test_only_new_frames_are_encoded(counted, n_action_steps):
    policy, seen = counted
    actor, td = ChunkExecutor(policy, n_action_steps), TensorDict({}, [2])
    for step in range(0, 4):
        td = actor(td.update(history(step, 2)))
        if td[keys.QUERIED].all():
            expected = policy.module["encode"].condition(history(step, 2))
            torch.testing.assert_close(td[keys.COND], expected, rtol=0, atol=1e-5)
    encoded = [count for index, count in enumerate(seen) if index % 2 == 0]  # the others are the test's own
    assert encoded == ([4, 2, 2, 2] if n_action_steps == 1 else [4, 4])


def test_rows_were_asked_at_different_times(counted):
    """One begins an episode, one was asked in the step before, and one two steps before, of which nothing is left."""
    policy, seen = counted
    first, second = (policy.module["encode"](history(step, 3)) for step in (3, 4))
    query = history(4, 3).set(keys.FRAME_FEATURES, first[keys.FRAME_FEATURES])
    query[keys.ELAPSED] = torch.tensor([[0], [1], [2]])
    seen.clear()
    got = policy.module["encode"](query)[keys.COND]
    torch.testing.assert_close(got, second[keys.COND], rtol=0, atol=1e-5)
    assert seen == [2 + 1 + 2]
    assert torch.equal(got[1, 0, :128], first[keys.FRAME_FEATURES][1, 1])


def test_a_policy_in_training_encodes_every_frame(counted):
    policy, seen = counted
    query = policy.module["encode"](history(3, 1))
    query.update(history(4, 1))[keys.ELAPSED] = torch.ones(1, 1, dtype=torch.int64)
    policy.module["encode"].condition.train()
    policy.vision.eval()
    seen.clear()
    policy.module["encode"](query)
    assert seen == [2]
