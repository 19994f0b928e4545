"""Weights in eight bits: how far they are off, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rl.int8 import packed, unpacked
from rl.policy import PolicyError, export_policy, load_policy
from rl.train import train
from tests.rl.toy import toy_config, toy_env


def test_no_weight_is_off_by_more_than_half_a_level_of_its_row():
    torch.manual_seed(0)
    weights = {
        "a.weight": torch.randn(40, 30) * torch.logspace(-6, 3, 40)[:, None],
        "a.bias": torch.randn(40),
        "zero.weight": torch.zeros(3, 5),
        "head.weight": torch.randn(4, 6),
    }
    small = packed(weights)
    assert small["a.weight"].dtype == torch.int8
    back = unpacked(small)
    assert back.keys() == weights.keys()
    most = weights["a.weight"].abs().amax(1, keepdim=True)
    # as numpy rounds, in double precision
    rows, top = weights["a.weight"].double().numpy(), most.double().numpy()
    np.testing.assert_allclose(
        back["a.weight"].numpy(), np.rint(rows / top * 127) * top / 127, atol=0, rtol=2e-6
    )
    assert ((back["a.weight"] - weights["a.weight"]).abs() <= most / 254 * 1.001).all()
    assert torch.equal(back["a.bias"], weights["a.bias"])
    assert torch.equal(back["head.weight"], weights["head.weight"])  # it is not packed
    assert torch.equal(back["zero.weight"], weights["zero.weight"])
    again = packed(back)  # what has been rounded stays
    assert torch.equal(again["a.weight"], small["a.weight"])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The same actor in fp16 and, from that file, in int8."""
    folder = tmp_path_factory.mktemp("int8")
    train(toy_config(folder / "run", samples=4 * 1024), environment=toy_env)
    half = export_policy(folder / "run", folder / "half")
    return half, export_policy(half, folder / "small", precision="int8")


def test_an_actor_in_int8_acts_alike_and_is_smaller(files):
    half, small = files
    obs = torch.randn(200, 1, 2)
    a, b = load_policy(half, "toy")(obs), load_policy(small, "toy")(obs)
    assert 0.0 < float((a - b).abs().max()) < 0.05 * float(a.abs().max())
    big, little = (load_file(f) for f in files)
    for name, weight in big.items():
        halved = weight.dim() == 2 and name != "head.weight"
        assert little[name].nbytes * (2 if halved else 1) == weight.nbytes, name
    cards = [json.loads(p.with_suffix(".json").read_text()) for p in files]
    assert [c.pop("precision") for c in cards] == ["float16", "int8"]
    assert cards[0].pop("sha256") != cards[1].pop("sha256")
    assert cards[0] == cards[1]


@pytest.mark.parametrize("harm", ["missing", "short", "stray"])
def test_scales_that_do_not_fit_are_refused(files, tmp_path, harm):
    import hashlib

    weights = load_file(files[1])
    if harm == "missing":
        del weights["trunk.2.weight.scale"]
    elif harm == "short":
        weights["trunk.0.weight.scale"] = weights["trunk.0.weight.scale"][1:].clone()
    else:
        weights["head.bias.scale"] = torch.ones(1)
    path = tmp_path / "p.safetensors"
    save_file(weights, path)
    card = json.loads(files[1].with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(PolicyError, match="damaged"):
        load_policy(path, "toy")
