"""Convert published demonstrations, and render cameras.

    python recipes/convert_demos.py demos=low_dim_v15.hdf5 out=data/lift_human.h5     # as robomimic publishes it
    python recipes/convert_demos.py demos=pusht_human.npz out=data/pusht_human.h5     # as Diffusion Policy publishes Push-T's
    python recipes/convert_demos.py demos=data/lift.h5 out=data/lift_images.h5 cameras=[agentview,robot0_eye_in_hand]

Deltas become absolute actions, observations are recomputed from the recorded states, images are copied. Diffusion Policy's
``*_abs.hdf5`` hold poses although they name a controller of deltas: give ``poses=true`` with them. Kill it at any moment and
run it again to go on: what is converted lies in OUT.parts, and before it is rendered in OUT.converted.
"""

from __future__ import annotations

from pathlib import Path
from zipfile import is_zipfile

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.absolute import convert_demos
from torchrl_sparse.data.hdf5_reader import demo_group, open_demos
from torchrl_sparse.data.pusht_human import convert_pusht
from torchrl_sparse.data.rendering import render_demos
from torchrl_sparse.errors import InputError


@recipe("convert_demos", out="file")
def main(config: DictConfig) -> None:
    demos, out = Path(config.demos), Path(config.out)
    kind, cameras = config.format or find_format(demos), list(config.cameras)
    check_read(config, kind)
    if demos.resolve() == out.resolve():
        raise InputError(f"out: expected another file than the demonstrations, got {out}")
    if not cameras:
        print(f"{out}: {convert(kind, demos, out, config.poses)}")
    elif config.format is None and not config.poses and is_ours(demos):
        render_demos(demos, out, cameras, image_size=config.image_size)
        print(f"{out}: images of {', '.join(cameras)}")
    else:
        converted = out.with_name(f"{out.name}.converted")
        told = convert(kind, demos, converted, config.poses)
        render_demos(converted, out, cameras, image_size=config.image_size)
        converted.unlink()
        print(f"{out}: {told}, images of {', '.join(cameras)}")


def find_format(demos: Path) -> str:
    """Tell Push-T's npz from robomimic's HDF5 by the file type; the reader of either refuses other content."""
    return "pusht" if demos.is_file() and is_zipfile(demos) else "robomimic"


def is_ours(demos: Path) -> bool:
    """Tell whether this library collected or converted the file, so that no conversion is needed."""
    with open_demos(demos) as file:
        return bool({"collection", "source_bytes"} & {*demo_group(file).attribute_names()})


def check_read(config: DictConfig, kind: str) -> None:
    """Refuse options that this conversion does not use, before anything is written."""
    if kind == "pusht" and config.cameras:
        raise InputError(f"cameras: expected [] of Push-T, which is not rendered, got {list(config.cameras)}")
    if kind == "pusht" and config.poses:
        raise InputError("poses: expected false of Push-T, whose actions are positions, got true")


def convert(kind: str, demos: Path, out: Path, poses: bool) -> str:
    """Convert a published file and return a summary of the new one."""
    if kind == "pusht":
        return f"{convert_pusht(demos, out)} demonstrations"
    return f"{convert_demos(demos, out, poses=poses)} demonstrations with absolute actions"


if __name__ == "__main__":
    main()
