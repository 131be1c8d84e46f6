"""Options of the conversion of demonstrations, which is left out: `tests/data` has it."""

from pathlib import Path

from tests.options.harness import OptionTests, Row


def converted(path, out, *, poses=False):
    Path(out).touch()
    return 2


def told(name, argument):
    """An argument of the first call of a function, None where it was not called."""
    return lambda run: run.calls[name][0][argument] if run.calls[name] else None


class TestOptions(OptionTests):
    recipe = "convert_demos"
    base = ("demos=low_dim_v15.hdf5", "out=made.h5")
    replaced = {
        "convert_demos": converted,
        "convert_pusht": converted,
        "render_demos": lambda *_, **__: None,
        "is_ours": lambda demos: False,
    }
    groups = (
        [
            Row("demos", "other.hdf5", lambda run: str(told("convert_demos", "path")(run))),
            Row("out", "data/made.h5", lambda run: str(told("render_demos", "out")(run)), "data/made.h5"),
            Row("poses", "true", told("convert_demos", "poses")),
            Row("cameras", "[agentview,birdview]", told("render_demos", "cameras"), ["agentview", "birdview"]),
            Row("image_size", "32", told("render_demos", "image_size"), 32),
        ],
        [
            Row("format", "pusht", lambda run: [n for n in ("pusht", "demos") if run.calls[f"convert_{n}"]], ["pusht"]),
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        (folder / "data").mkdir()
