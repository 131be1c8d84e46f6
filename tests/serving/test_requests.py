"""Observations come under the contract's names or openpi's, flat or nested."""

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.envs.contract import Contract, task_contract
from torchrl_sparse.serving.requests import RequestReader

STATE = np.arange(19.0)
LIFT = task_contract("lift")
CAMERAS = Contract(None, ("gripper", "arm"), cameras={"image": "agentview_image"})


def parts():
    sizes = {"object": 10, "robot0_eef_pos": 3, "robot0_eef_quat_site": 4, "robot0_gripper_qpos": 2}
    assert [*sizes] == [*LIFT.state_keys]
    ends = np.cumsum([*sizes.values()])[:-1]
    return dict(zip(sizes, np.split(STATE, ends), strict=True))


@pytest.mark.parametrize(
    "content",
    [
        {"state": STATE},
        {"observation/state": STATE, "prompt": "lift the cube"},
        {"observation": {"state": STATE}},
        parts(),
        dict(reversed(parts().items())),
        {"observation": parts()},
        {f"observation/{name}": part for name, part in parts().items()},
    ],
    ids=lambda content: ",".join(content)[:30],
)
def test_the_state_is_the_same_under_every_name(content):
    request = RequestReader(LIFT)(content)
    assert [*request.observation] == ["state"]
    np.testing.assert_array_equal(request.observation["state"], STATE)
    assert (request.reset, request.seed) == (False, None)


@pytest.mark.parametrize("name", ["image", "agentview_image", "observation/image", "images/agentview_image"])
def test_a_camera_has_two_names(name):
    image = np.zeros((4, 4, 3), np.uint8)
    read = RequestReader(CAMERAS)({name: image, "gripper": np.ones(1), "arm": np.zeros(2)}).observation
    assert {*read} == {"image", "state"}
    assert read["image"] is image
    np.testing.assert_array_equal(read["state"], [1, 0, 0])


def test_histories_are_joined_step_by_step():
    history = {name: np.stack([part, part + 100]) for name, part in parts().items()}
    np.testing.assert_array_equal(RequestReader(LIFT)(history).observation["state"], [STATE, STATE + 100])


def test_an_episode_is_begun_with_a_seed():
    request = RequestReader(LIFT)({"state": STATE, "episode": {"reset": np.bool_(True), "seed": np.int32(7)}})
    assert (request.reset, request.seed) == (True, 7)


@pytest.mark.parametrize(
    ("entry", "content"),
    [
        ("message", [STATE]),
        ("message", {b"state": STATE}),
        ("observation/state", {"state": STATE, "observation/state": STATE}),
        ("state", {"state": [1.0, 2.0]}),
        ("prompt", {"state": STATE, "prompt": 3}),
        ("episode/reset", {"state": STATE, "episode/reset": 1}),
        ("episode/seed", {"state": STATE, "episode/seed": -1}),
        ("episode/seed", {"state": STATE, "episode/seed": 2**31}),
        ("episode/seed", {"state": STATE, "episode/seed": True}),
        ("a/b/c/d", {"a": {"b": {"c": {"d": {}}}}}),
        ("object", {name: part for name, part in parts().items() if name != "object"}),
        ("object", parts() | {"object": np.zeros(9)}),
        ("robot0_eef_pos", parts() | {"robot0_eef_pos": np.float64(1)[None][0:0]}),
    ],
)
def test_what_does_not_fit_is_refused_by_name(entry, content):
    with refused(entry):
        RequestReader(LIFT)(content)
