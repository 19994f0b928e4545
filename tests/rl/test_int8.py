"""Weights in eight bits: how far they are off, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rl import calibration
from rl.int8 import fitted, packed, unpacked
from rl.networks import MLP
from rl.policy import PolicyError, export_policy, load_policy, packed_weights, write_policy
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


def mixed(rows: int, inputs: int, seed: int) -> torch.Tensor:
    """Inputs that go together and have means, like those of an athlete."""
    generator = torch.Generator().manual_seed(3)
    mixing = torch.randn(max(2, inputs // 10), inputs, generator=generator)
    offset = torch.randn(inputs, generator=generator)
    generator.manual_seed(seed)
    noise = torch.randn(rows, inputs, generator=generator)
    return (
        torch.randn(rows, max(2, inputs // 10), generator=generator) @ mixing
        + offset
        + 0.05 * noise
    )


def rounded(actor: MLP, weights: dict[str, torch.Tensor]) -> MLP:
    """The same actor with what int8 weights stand for."""
    other = MLP(actor.trunk[0].in_features, (24, 18), 5)
    other.load_state_dict({k: v.float() for k, v in unpacked(weights).items()})
    return other


def test_weights_fitted_to_inputs_keep_the_outputs_and_their_means():
    """For inputs like those that they were fitted to, nearer by half than weights that were
    rounded each by itself; in a file of the same size."""
    torch.manual_seed(1)
    actor = MLP(30, (24, 18), 5)
    plain = packed({k: v.half() for k, v in actor.state_dict().items()})
    close = fitted(actor, mixed(4000, 30, seed=5))
    assert {k: (v.dtype, v.shape) for k, v in close.items()} == {
        k: (v.dtype, v.shape) for k, v in plain.items()
    }
    x = mixed(4000, 30, seed=6)
    off = [(rounded(actor, w)(x) - actor(x)).detach() for w in (plain, close)]
    assert off[1].square().mean().sqrt() < 0.5 * off[0].square().mean().sqrt()
    assert off[1].mean(0).abs().max() < 0.25 * off[0].mean(0).abs().max()
    with pytest.raises(ValueError, match="there are none"):
        fitted(actor, x[:0])


def test_a_column_makes_good_what_rounding_did_to_those_before():
    """Each weight is rounded from where least squares puts it once those before it are rounded,
    the largest input's first: the rest moves by <rest rest>^-1 <rest before> (w - q)."""
    torch.manual_seed(2)
    actor = MLP(6, (50,), 3)
    x = mixed(5000, 6, seed=5)
    order = np.argsort(-x.double().square().mean(0).numpy())
    assert not np.array_equal(order, range(6))
    x = x[:, order]
    got = fitted(actor, x[:, np.argsort(order)])["trunk.0.weight"].numpy()[:, order]
    weight = actor.trunk[0].weight.detach().double().numpy()[:, order]
    scale = np.abs(weight).max(1, keepdims=True) / 127
    moments = x.double().numpy().T @ x.double().numpy() / len(x)
    moments += 0.003 * moments.trace() / 6 * np.eye(6)
    levels = np.zeros_like(weight)
    for j in range(6):
        error = weight[:, :j] - levels[:, :j] * scale
        moved = np.linalg.solve(moments[j:, j:], moments[j:, :j] @ error.T).T
        best = (weight[:, j] + moved[:, 0]) / scale[:, 0]
        levels[:, j] = np.clip(np.rint(best), -127, 127)
    assert (got == levels).mean() > 0.99  # float32 scales, ties
    assert (levels != np.rint(weight / scale)).mean() > 0.1


def test_the_last_layer_makes_good_what_rounding_did_to_those_before():
    """Numpy's least squares, with rows that hold the weights where they were: of the errors of the
    actions more than half go that way."""
    torch.manual_seed(3)
    actor = MLP(30, (24, 18), 5)
    x = mixed(4000, 30, seed=5)
    close = rounded(actor, fitted(actor, x))
    exact, near = (a.trunk(x).detach().double().numpy() for a in (actor, close))
    exact, near = exact - exact.mean(0), near - near.mean(0)
    weight = actor.head.weight.detach().double().numpy()
    hold = np.sqrt(1e-3 * np.square(near).mean() * len(x)) * np.eye(18)
    wanted = np.vstack((exact @ weight.T, hold @ weight.T))
    best = np.linalg.lstsq(np.vstack((near, hold)), wanted, rcond=None)[0].T
    got = close.head.weight.detach().numpy()
    np.testing.assert_allclose(got, best, rtol=2e-3, atol=2e-4)  # float16
    assert (
        np.square(exact @ weight.T - near @ best.T).mean()
        < 0.5 * np.square(exact @ weight.T - near @ weight.T).mean()
    )


def test_a_policy_is_rounded_for_what_it_meets_in_its_own_task(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, "WORLDS", 8)
    monkeypatch.setattr(calibration, "STEPS", 40)
    policy = load_policy("pretrained:ppo-human", "high_jump")
    assert policy.actor is not None
    obs = calibration.observed(policy)
    assert obs.shape == (8 * 40, policy.metadata["obs_size"]) and obs.isfinite().all()
    assert torch.equal(obs, calibration.observed(policy))
    source = tmp_path / "half.safetensors"
    generator = torch.Generator().manual_seed(4)
    weights = {  # no whole levels any more
        name: w * (1.0 + 0.01 * torch.randn(w.shape, generator=generator))
        for name, w in policy.actor.state_dict().items()
    }
    write_policy(packed_weights(weights), policy.metadata | {"precision": "float16"}, source)
    plain = export_policy(source, tmp_path / "plain", precision="int8")
    close = export_policy(
        source, tmp_path / "close", precision="int8", observed=calibration.observed
    )
    assert close.stat().st_size == plain.stat().st_size
    monkeypatch.setattr(calibration, "SEED", 5)
    policy = load_policy(source, "high_jump")
    met = calibration.observed(policy)[:, None]
    off = [
        float((load_policy(path, "high_jump")(met) - policy(met)).square().mean().sqrt())
        for path in (plain, close)
    ]
    assert off[1] < 0.5 * off[0]


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
