"""A method as a value: every label that is in use reads and prints as it is written, and so does every value that has one."""

import json
import random
import re

import pytest

from tests.pages import PAGES, ROOT
from torchrl_sparse import MethodSpec
from torchrl_sparse.methods.spec import WEIGHTS

SAMPLERS = ("ddim10", "ddpm5_logsnr", "ddpm_82_14", "ddim4_trailing_eta0.5", "ddim2_eta0", "unipc_90_50_3")


def drawn(choose):
    """Return a method that has a label, its fields drawn by a `random.Random`."""

    def count():
        return choose.choice((1, 2, 10, choose.randint(1, 10**6)))

    head = {"planner": choose.choice(("dense_noise", "bac_ddpm10", "sag", "mine_0.5", "l2c"))}
    if choose.random() < 0.7:
        head = choose.choice(({}, {"planner": "uniform", "interval": count()}))
        if not head or choose.random() < 0.5:
            start = choose.choice(({}, {"warm": count()}, {"rtc": True}))
            head = {**head, "sampler": choose.choice(SAMPLERS), **start}
    rates = tuple(choose.choice((0.0, 0.95, 2.0, choose.random(), 1e-9)) for _ in range(choose.randint(0, 2)))
    like = {} if rates else {"like": choose.choice((None, "specprune", "specprune@0.4"))}
    return MethodSpec(
        **head,
        **like,
        rates=rates,
        every=choose.choice((None, count())),
        samples=count(),
        ensembled=choose.random() < 0.5,
        ahead=choose.random() < 0.5,
        weights=choose.choice((None, *WEIGHTS)),
    )


def used():
    """Return the labels in options of recipes, published tables and pages."""
    found = set()
    for path in [
        *ROOT.glob("recipes/**/*.yaml"),
        *ROOT.glob("recipes/**/*.py"),
        *PAGES.values(),
        ROOT / "Makefile",
    ]:
        for listed in re.findall(r"methods(?:=|: )\[([^\]<{*]*)\]", path.read_text(encoding="utf-8")):
            found |= {label.strip(" \"'\n\\") for label in listed.split(",")}
    for path in ROOT.glob("assets/**/results.json"):
        methods = json.loads(path.read_text(encoding="utf-8")).get("methods", ())
        found |= set(methods)
    return sorted(label for label in found if label and label[0] != "$")


def test_every_label_in_use_is_printed_as_it_was_written():
    labels = used()
    assert len(labels) > 100
    assert {"dense_noise", "ddpm5_logsnr:int8", "ddpm5_logsnr_warm2", "specprune@0.17"} <= {*labels}
    for label in labels:
        assert str(MethodSpec.parse(label)) == label


def test_every_value_is_read_back_from_its_label():
    choose = random.Random(0)
    specs = {drawn(choose) for _ in range(2000)}
    assert len({str(spec) for spec in specs}) == len(specs) > 1500
    for spec in specs:
        assert MethodSpec.parse(str(spec)) == spec
        assert MethodSpec.parse(spec) is spec


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"planner": "ddim10"}, "planner: expected 'dense', as 'ddim10' is read, got 'ddim10'"),
        ({"planner": "mine_every2"}, "planner: expected 'mine', as 'mine_every2' is read, got 'mine_every2'"),
        ({"planner": "bac", "sampler": "ddim10"}, "planner: expected 'bac_ddim10', .*, got 'bac'"),
        ({"warm": 2}, "planner: expected 'dense_warm2', .*, got 'dense'"),
        ({"rates": [0.5]}, r"rates: expected \(0.5,\), .*, got \[0.5\]"),
        ({"weights": "fp4"}, "methods: expected NAME, .*, got 'dense:fp4'"),
        ({"samples": 0}, "methods: expected NAME, .*, got 'dense_of0'|samples: .*|planner: .*"),
    ],
)
def test_values_without_a_label_are_refused(fields, message):
    with pytest.raises(ValueError, match=f"^(?:{message})$"):
        MethodSpec(**fields)
