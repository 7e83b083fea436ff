"""Refitted networks act as those they come from, and see what is new only once they have learned to."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from rsl_rl.modules import EmpiricalNormalization

from cotap.agents.actors import DualActorCritic, Observations, as_dict
from cotap.agents.checkpoint import CheckpointError
from cotap.agents.refit import REFITTED, columns, spread, take_over
from cotap.agents.runner import layout_of
from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv
from cotap.envs.modulation import ModulationConfig
from cotap.envs.observations import NoiseConfig, ObservationConfig
from cotap.envs.upper_body import UpperBodyConfig

HISTORY, TORQUES, GOALS = 5, 8, 10
STEP = 86
"""Width of one step of the observation."""
MakeEnv = Callable[..., HumanoidEnv]


def observations(env: HumanoidEnv, seed: int) -> Observations:
    rng = torch.Generator().manual_seed(seed)
    return {k: 1.0 + torch.randn(v.shape, generator=rng) for k, v in as_dict(env.get_observations()).items()}


def trained(env: HumanoidEnv, symmetric: bool) -> DualActorCritic:
    """Networks with weights and statistics of their own."""
    torch.manual_seed(3)
    model = DualActorCritic(layout_of(env, symmetric), (16, 8), 0.4)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, 0.1, 0.3)
    model.update_normalizers(observations(env, 1))
    return model.eval()


def content(env: HumanoidEnv, model: DualActorCritic) -> dict[str, Any]:
    return {"layout": json.loads(json.dumps(env.layout())), "model": model.state_dict()}


def mean(model: DualActorCritic) -> torch.Tensor:
    """What actors' observations are normalised by."""
    return cast(EmpiricalNormalization, model.normalizers["policy"]).mean


def fresh(env: HumanoidEnv, symmetric: bool) -> DualActorCritic:
    torch.manual_seed(4)
    return DualActorCritic(layout_of(env, symmetric), (16, 8), 1.0)


def values(model: DualActorCritic, x: Observations) -> torch.Tensor:
    read = model.read("critic", model.normalize(x))
    return torch.cat([critic(read) for critic in model.critics.values()], 1)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("critic", ["present", "history"])
def test_what_is_new_is_ignored_at_first(make_env: MakeEnv, symmetric: bool, noise: bool, critic: str):
    noisy = NoiseConfig(enabled=noise)
    before = make_env(observations=ObservationConfig(noise=noisy, critic=critic))
    now = make_env(observations=ObservationConfig(goals=True, noise=noisy, critic=critic))
    old, new = trained(before, symmetric), fresh(now, symmetric)
    assert take_over("c.pt", content(before, old), new, now, other=REFITTED)
    x = observations(now, 2)
    new_columns = {"privileged": 0, "present": GOALS, "policy": HISTORY * GOALS, "clean": HISTORY * GOALS}
    without = {k: v[:, : v.shape[1] - new_columns[k]] for k, v in x.items()}
    torch.testing.assert_close(new.eval()(x), old(without))
    torch.testing.assert_close(values(new, x), values(old, without))
    assert float(old(without).detach().std()) > 0.1
    for name in old.log_std:
        assert torch.equal(new.log_std[name], old.log_std[name])


@pytest.mark.parametrize("symmetric", [True, False])
def test_what_has_gone_counts_as_at_its_mean(make_env: MakeEnv, symmetric: bool):
    before = make_env()
    now = make_env(observations=ObservationConfig(arm_torque="critic"))
    old, new = trained(before, symmetric), fresh(now, symmetric)
    take_over("c.pt", content(before, old), new, now, other=REFITTED)
    x = observations(before, 2)
    blind = x["policy"].clone()
    blind[:, -HISTORY * TORQUES :] = mean(old)[-HISTORY * TORQUES :]
    expected = old({"policy": blind})
    without = {"policy": x["policy"][:, : -HISTORY * TORQUES]}
    torch.testing.assert_close(new.eval()(without), expected)
    assert (expected - old(x)).abs().max() > 0.1


@pytest.mark.parametrize(("critic", "steps"), [("present", 1), ("history", HISTORY)])
def test_critics_keep_the_weights_of_what_they_alone_still_see(make_env: MakeEnv, critic: str, steps: int):
    before = make_env(observations=ObservationConfig(critic=critic))
    now = make_env(observations=ObservationConfig(arm_torque="critic", critic=critic))
    old, new = trained(before, True), fresh(now, True)
    take_over("c.pt", content(before, old), new, now, other=REFITTED)
    seen, kept = STEP * steps, (STEP - TORQUES) * steps
    was, has = (m.state_dict()["critics.upper.weights.0"] for m in (old, new))
    newest = was[:, kept:seen].reshape(-1, steps, TORQUES)[:, -1]
    # Orientation and velocity come before the torques.
    assert torch.equal(has, torch.cat((was[:, :kept], was[:, seen : seen + 7], newest, was[:, seen + 7 :]), 1))


@pytest.mark.parametrize(
    ("noise", "critic", "source"),
    [(False, "present", "present"), (False, "history", "policy"), (True, "present", "present"),
     (True, "history", "clean")],
)  # fmt: skip
def test_critics_keep_the_statistics_of_what_they_alone_still_see(
    make_env: MakeEnv, noise: bool, critic: str, source: str
):
    """Else weights that were learned on numbers of the order of one would meet others."""
    noisy = NoiseConfig(enabled=noise)
    before = make_env(observations=ObservationConfig(noise=noisy, critic=critic))
    now = make_env(observations=ObservationConfig(arm_torque="critic", noise=noisy, critic=critic))
    old, new = trained(before, True), fresh(now, True)
    take_over("c.pt", content(before, old), new, now, other=REFITTED)
    was, has = old.state_dict(), new.state_dict()
    for key in ("_mean", "_std", "_var"):
        mine = has[f"normalizers.privileged.{key}"][:, 7 : 7 + TORQUES]
        assert torch.equal(mine, was[f"normalizers.{source}.{key}"][:, -TORQUES:])
        rest = has[f"normalizers.privileged.{key}"]
        rest = torch.cat((rest[:, :7], rest[:, 7 + TORQUES :]), 1)
        assert torch.equal(rest, was[f"normalizers.privileged.{key}"])


def test_what_only_critics_see_may_change_alone(make_env: MakeEnv):
    """As from a base whose critics saw less; actors act as before."""
    now = make_env()
    old, new = trained(now, True), fresh(now, True)
    given = content(now, old)
    given["layout"]["critic_terms"] = [["scent", width, 1.0] for _, width, _ in given["layout"]["critic_terms"]]
    assert take_over("c.pt", given, new, now, other=("critic_terms",))
    x = observations(now, 2)
    torch.testing.assert_close(new.eval()(x), old(x))
    assert not new.state_dict()["critics.lower.weights.0"][:, STEP:].any()
    with pytest.raises(CheckpointError, match="another terms"):
        take_over("c.pt", content(now, old), fresh(now, True), make_env(observations=ObservationConfig(goals=True)),
                  other=("critic_terms",))  # fmt: skip


def test_statistics_of_what_is_new_are_those_of_the_envs(make_env: MakeEnv):
    before, now = make_env(), make_env(64, observations=ObservationConfig(goals=True))
    new = fresh(now, True)
    take_over("c.pt", content(before, trained(before, True)), new, now, other=REFITTED)
    goals = now.get_observations()["policy"][:, -GOALS:]
    both = torch.cat((goals, goals[:, [5, 6, 7, 8, 9, 0, 1, 2, 3, 4]]))
    torch.testing.assert_close(mean(new)[-GOALS:], both.mean(0), atol=1e-4, rtol=1e-4)


def test_columns_run_term_by_term_and_oldest_first():
    layout = {"terms": [["a", 2, 1.0], ["b", 1, 3.0]], "critic_terms": [["c", 2, 1.0]], "history": 2}
    assert columns(layout) == {
        "policy": [("a", 2), ("a", 3), ("a", 0), ("a", 1), ("b", 1), ("b", 0)],
        "clean": [("a", 2), ("a", 3), ("a", 0), ("a", 1), ("b", 1), ("b", 0)],
        "present": [("a", 0), ("a", 1), ("b", 0)],
        "privileged": [("c", 0), ("c", 1)],
    }


def test_what_never_varied_is_not_seen_hundreds_of_deviations_away():
    of_policy = {"_mean": [[0.0, 1.0]], "_std": [[0.0, 2.0]], "_var": [[0.0, 4.0]]}
    found = spread({f"normalizers.policy.{name}": torch.tensor(value) for name, value in of_policy.items()})
    now = {name.removeprefix("normalizers.policy."): value.tolist() for name, value in found.items()}
    assert now == {"_mean": [[0.0, 1.0]], "_std": [[1.0, 2.0]], "_var": [[1.0, 4.0]]}


def test_nothing_is_refitted_where_nothing_differs(make_env: MakeEnv):
    env = make_env()
    old, new = trained(env, True), fresh(env, True)
    assert not take_over("c.pt", content(env, old), new, env, other=REFITTED)
    assert all(torch.equal(v, old.state_dict()[k]) for k, v in new.state_dict().items())


@pytest.mark.parametrize(
    ("saved", "other", "needle"),
    [
        ({}, (), "another terms"),
        ({"robot": "g1"}, REFITTED, "another robot: 'g1', here 'h1'"),
        ({"history": 3}, REFITTED, "another history: 3, here 5"),
        ({"terms": [["a"]]}, REFITTED, "other networks"),
        ({"terms": torch.ones(3)}, REFITTED, "other networks"),
        ({"critic_terms": None}, REFITTED, "other networks"),
    ],
)
def test_what_cannot_be_refitted_is_refused(
    make_env: MakeEnv, saved: dict[str, Any], other: tuple[str, ...], needle: str
):
    before, now = make_env(), make_env(observations=ObservationConfig(goals=True))
    given = content(before, trained(before, True))
    given["layout"] |= saved
    new = fresh(now, True)
    with pytest.raises(CheckpointError, match=needle):
        take_over("c.pt", given, new, now, other)


def test_critics_that_read_something_else_are_refused_by_name(make_env: MakeEnv):
    before, now = make_env(), make_env(observations=ObservationConfig(critic="history"))
    given = content(before, old := trained(before, True)) | {"agents": old.layout.to_plain()}
    with pytest.raises(CheckpointError, match=r"read the observations .*present.* not .*env\.observations\.critic"):
        take_over("c.pt", given, fresh(now, True), now, other=REFITTED)


def test_networks_of_another_width_are_refused(make_env: MakeEnv):
    before, now = make_env(), make_env(observations=ObservationConfig(goals=True))
    wide = DualActorCritic(layout_of(now), (32, 8), 1.0)
    with pytest.raises(CheckpointError, match="other networks"):
        take_over("c.pt", content(before, trained(before, True)), wide, now, other=REFITTED)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("kind", ["alpha", "stiffness"])
def test_new_actions_are_zero_at_first(make_env: MakeEnv, symmetric: bool, kind: str):
    laws = [LawConfig("cotap", alpha=0.5) for _ in range(2)]
    before, now = make_env(), make_env(upper_body=UpperBodyConfig(*laws, modulation=ModulationConfig(kind)))
    old, new = trained(before, symmetric), fresh(now, symmetric)
    assert take_over("c.pt", content(before, old), new, now, other=REFITTED)
    x = observations(now, 2)
    shown, joints = now.num_actions - before.num_actions, before.num_actions
    steps = {"privileged": 0, "present": 1, "policy": HISTORY, "clean": HISTORY}
    without = {k: v[:, : v.shape[1] - steps[k] * shown] for k, v in x.items()}
    action = new.eval()(x)
    torch.testing.assert_close(action[:, :joints], old(without))
    assert not action[:, joints:].any()
    torch.testing.assert_close(values(new, x), values(old, without))
    arms = len(old.log_std["upper"])
    assert torch.equal(new.log_std["upper"][:arms], old.log_std["upper"])
    assert torch.equal(new.log_std["upper"][arms:], torch.zeros(shown))  # as fresh networks explore
    new(x)[:, joints:].sum().backward()
    last = "output_weight" if symmetric else "mlp.4.weight"
    assert float(dict(new.actors["upper"].named_parameters())[last].grad[arms:].abs().max()) > 0.0  # they can learn
    with pytest.raises(CheckpointError, match="other networks"):
        take_over("c.pt", content(now, new), fresh(before, symmetric), before, other=REFITTED)


@pytest.mark.parametrize("symmetric", [True, False])
def test_laws_are_read_at_the_order_of_one_wherever_actions_bring_them(make_env: MakeEnv, symmetric: bool):
    """Every env begins with the same law, whose spread is none; as learned, normalised ones would be 50 and more."""
    law = LawConfig("cotap", alpha=0.5)
    before = make_env()
    now = make_env(16, upper_body=UpperBodyConfig(law, law, modulation=ModulationConfig("stiffness")))
    new = fresh(now, symmetric)
    take_over("c.pt", content(before, trained(before, symmetric)), new, now, other=REFITTED)
    rng = torch.Generator().manual_seed(0)
    asked = 4.0 * torch.randn(16, 8, generator=rng)  # far beyond the bounds
    for _ in range(20):
        now.step(torch.cat((torch.zeros(16, now.num_actions - 8), asked), 1))
    seen = now.get_observations()["policy"]
    law_columns = new.eval().normalizers["policy"](seen)[:, -8 * HISTORY :]
    assert float(seen[:, -8 * HISTORY :].std(0).min()) > 0.1
    assert float(law_columns.std(0).min()) > 0.1
    assert float(law_columns.abs().max()) < 2.0
