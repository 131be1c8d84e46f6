"""Rendering of camera images for demonstrations recorded without them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import ParseError

import numpy as np
from tqdm import tqdm

from torchrl_sparse.data.demos import read_initial_state
from torchrl_sparse.data.hdf5_files import new_hdf5
from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import ArrayReader, demo_group, demo_names, open_demo, open_demos
from torchrl_sparse.data.recorded_control import read_control
from torchrl_sparse.envs.robosuite import InitialState, RobosuiteEnv
from torchrl_sparse.errors import InputError

__all__ = ["render_demos"]


def render_demos(path: str | Path, out: str | Path, cameras: Sequence[str], *, image_size: int = 84) -> None:
    """Copy a demonstration file and add camera images and object positions to every demonstration.

    ``obs/<camera>_image``, u8 [T, h, w, 3]; and ``obs/object_positions``, f32 [T, 3 n] in m, where the scene's n objects are:
    no policy reads it, but vision can be trained to tell it.

    Images are rendered from the simulator states that were recorded, so experts run once and cameras can be
    chosen later. Pictures of a running episode are one physics step, 2 ms, behind its states; these are not.
    ``out`` appears when it is complete.

    Args:
        path: a file of `torchrl_sparse.data.demos.collect`, or of `torchrl_sparse.data.absolute.convert_demos` if the models
            that it recorded are of robosuite 1.5.
        out: the file to write.
        cameras: robosuite's names, e.g. "agentview" and "robot0_eye_in_hand".
        image_size: height and width, pixels.

    Raises:
        FileNotFoundError: if there is no file.
        RuntimeError: if no GL library is installed.
        InputError: naming the demonstration, if one is damaged or its model is none of robosuite 1.5; if there is no such
            camera, it has images of one already, or ``out`` is ``path``.
    """
    if Path(path).resolve() == Path(out).resolve():
        raise InputError(f"out: expected another file than the demonstrations, got {out}")
    with open_demos(path) as source, new_hdf5(out) as file:
        env = RobosuiteEnv(read_control(source).env_name)
        for name in source.names():  # the demonstrations and their filter keys
            source.copy(file, name)
        for name in tqdm(demo_names(source), unit="demo"):
            demo, length = open_demo(demo_group(source), name)
            present = _present(demo, cameras)
            states = ArrayReader(source).numbers(demo, "states", length)
            _restore(env, demo, read_initial_state(path, int(name[5:])))
            for key, values in _render(env, states, cameras, image_size).items():
                if key not in present:
                    file["data"][name].create_dataset(f"obs/{key}", data=values, compression="lzf")
        env.close()


def _present(demo: Node, cameras: Sequence[str]) -> set[str]:
    """Return the names of a demonstration's observations, of which none may be an image of ``cameras``."""
    observed = demo.find("obs")
    present = {*(observed.names() if observed is not None and observed.is_group else ())}
    if again := [camera for camera in cameras if f"{camera}_image" in present]:
        raise InputError(
            f"{demo.where}: cameras: expected ones that it has no images of, got {', '.join(again)}"
        )
    return present


def _restore(env: RobosuiteEnv, demo: Node, start: InitialState) -> None:
    """Put the environment at a demonstration's start."""
    size = len(env.sim_env.sim.get_state().flatten())
    if len(start.sim_state) != size:
        raise InputError(
            f"{demo.where}, states: expected {size} numbers of {env.task.name}, got {len(start.sim_state)}"
        )
    try:
        env.reset(initial_state=start)
    except (ValueError, KeyError, AttributeError, ParseError) as error:
        raise InputError(
            f"{demo.where}, model_file: expected a model of robosuite 1.5, got one that it cannot play "
            f"({' '.join(str(error).split())[:200]})"
        ) from error


def _render(
    env: RobosuiteEnv, states: np.ndarray, cameras: Sequence[str], size: int
) -> dict[str, np.ndarray]:
    """Render each state, by the names of observations."""
    seen = []
    for state in states:
        env.sim_env.sim.set_state_from_flattened(state)
        env.sim_env.sim.forward()
        images = {f"{camera}_image": env.render(camera, size, size) for camera in cameras}
        seen.append(images | {"object_positions": env.object_positions().astype(np.float32)})
    return {key: np.stack([step[key] for step in seen]) for key in seen[0]}
