"""Which patches changed, and what the comparison remembers."""

import dataclasses

import pytest
import torch
from torch.nn import functional

from tests.refusals import refused
from tests.tokens.helpers import CONFIG, SPEC, later, patch, query
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.vision import center_crop
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner
from torchrl_sparse.tokens.frames import compare_frames, patches, similarity
from torchrl_sparse.tokens.specprune import SpecPrune


def test_patches_are_cut_row_by_row_and_camera_by_camera():
    frames = torch.stack([query()[camera] for camera in SPEC.cameras], 1)
    cut = patches(frames, SPEC.grid)
    assert cut.shape == (3, SPEC.num_visual, 3 * 14 * 14)
    for camera in range(2):
        for index in range(SPEC.per_camera):
            expected = frames[:, camera][patch(camera, index)].flatten(1).double()
            assert torch.equal(
                cut[:, camera * SPEC.per_camera + index].sort(-1).values, expected.sort(-1).values
            )


def test_frames_that_patches_do_not_divide_are_named():
    with refused("frames"):
        patches(torch.zeros(1, 2, 3, 30, 56, dtype=torch.uint8), (4, 4))


def test_similarity_is_the_cosine():
    previous, current = torch.rand(2, 50, 9, generator=torch.Generator().manual_seed(0)).double().unbind()
    expected = functional.cosine_similarity(previous, current, dim=-1).float()
    torch.testing.assert_close(similarity(previous, current), expected)
    assert (similarity(previous, previous) > 1 - 1e-6).all()


def test_black_patches_are_alike_and_unlike_all_others():
    black, white = torch.zeros(1, 9), torch.full((1, 9), 255.0)
    assert similarity(black, black).item() == 1
    assert similarity(black, white).item() == similarity(white, black).item() == 0


def test_only_what_changed_is_unlike():
    td = query()
    compare_frames(td, SPEC)
    changed = [(0, 3), (0, 15), (1, 0), (1, 7)]
    alike, first = compare_frames(later(td, changed), SPEC)
    assert not first.any()
    assert (alike < 0.99).nonzero()[:, 1].reshape(3, -1).tolist() == [[3, 15, 16, 23]] * 3


def test_first_queries_are_told_apart_and_the_images_are_remembered():
    td = query()
    _, first = compare_frames(td, SPEC)
    assert first.all()
    assert torch.equal(td[keys.TOKEN_FRAMES][:, 1], td[keys.WRIST_IMAGE])
    following = later(td)
    following[keys.IS_INIT] = torch.tensor([[False], [True], [False]])
    _, first = compare_frames(following, SPEC)
    assert first.flatten().tolist() == [False, True, False]
    assert torch.equal(following[keys.TOKEN_FRAMES][:, 0], following[keys.IMAGE])


def test_without_a_history_there_is_nothing_to_compare_with():
    td = query()
    td[keys.IS_INIT] = torch.zeros(3, 1, dtype=torch.bool)  # a loop that starts in mid-episode
    assert compare_frames(td, SPEC)[1].all()
    with pytest.raises(KeyError, match="is_init"):
        compare_frames(query().exclude(keys.IS_INIT), SPEC)


def unlike(td, furthest=3):
    """Patches that changed, of each row, as the comparison sees it."""
    alike, first = compare_frames(td, SPEC, furthest, swift=0.3)
    return [
        None if new else (row < 0.99).nonzero().flatten().tolist()
        for row, new in zip(alike, first, strict=True)
    ]


def test_the_slower_the_hand_the_further_back_is_the_frame():
    """Patch 1 changes at the second policy call, 2 at the third and so on; three hands at rest, slow and swift."""
    td, speeds = query(), torch.tensor([0.0, 0.15, 0.3])
    td[keys.EEF_VEL][:, 2] = -speeds
    seen = [unlike(td)]
    for number in range(1, 5):
        td = later(td, [(0, number)], seed=number)
        seen.append(unlike(td))
    assert seen[0] == [None] * 3
    assert seen[1] == [[1]] * 3  # there is one frame only
    assert seen[2] == [[1, 2], [1, 2], [2]]
    assert seen[3] == [[1, 2, 3], [2, 3], [3]]
    assert seen[4] == [[2, 3, 4], [3, 4], [4]]  # three back, and no further
    td = later(td, [(0, 5)])
    td[keys.IS_INIT] = torch.tensor([[False], [True], [True]])
    assert unlike(td) == [[3, 4, 5], None, None]
    assert unlike(later(td, [(0, 6)])) == [[4, 5, 6], [6], [6]]  # nothing is left of the last episode


def test_of_two_arms_the_slower_decides():
    td = query()
    td[keys.EEF_VEL] = torch.zeros(3, 12).index_fill_(1, torch.tensor([0]), 9.0)
    unlike(td)
    td = later(td, [(0, 1)])
    unlike(td)
    assert unlike(later(td, [(0, 2)], seed=2)) == [[1, 2]] * 3


def test_looking_back_takes_a_query_and_the_speed():
    with refused("look_back"):
        SpecPrune(look_back=0)
    td = query()
    unlike(td)
    with pytest.raises(KeyError, match="eef_vel"):
        unlike(later(td).exclude(keys.EEF_VEL))


def test_patches_are_those_of_the_crop_that_the_network_sees():
    """A crop of half the sides: pixels 14 to 41 of 56 fill the network's image, so 7 of them are a patch."""
    policy = VLAPolicy(VLANetwork(dataclasses.replace(CONFIG, crop_area=0.25)))
    policy.pruner = FrameDifferencePruner(share=1 / SPEC.per_camera)
    first = policy(query())
    cropped = center_crop(query()[keys.IMAGE], 0.25)
    assert torch.equal(first[keys.TOKEN_FRAMES][:, 0], cropped)
    assert not torch.equal(cropped, query()[keys.IMAGE])
    assert torch.equal(first[keys.IMAGE], query()[keys.IMAGE])  # nobody else sees a crop

    second = first.clone().set(keys.IS_INIT, torch.zeros(3, 1, dtype=torch.bool))
    second[keys.IMAGE][:, :, :14] = 255 - second[keys.IMAGE][:, :, :14]  # seen by no one
    for camera in (keys.IMAGE, keys.WRIST_IMAGE):
        area = second[camera][..., 28:34, 36:41]  # within row 2, column 3 of the crop's patches
        area.copy_(255 - area)
    kept = (policy(second)[keys.TOKEN_DEPTH] > 0).nonzero().reshape(3, 2, 2)[..., 1]
    assert kept.tolist() == [[2 * 4 + 3, SPEC.per_camera + 2 * 4 + 3]] * 3
