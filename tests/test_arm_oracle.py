"""The oracle of the arms' targets: offsets of known inertia and stiffness, and the table that it fills."""

from __future__ import annotations

import mujoco
import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.upper_body import UpperBodyConfig
from reports import arm_oracle


@pytest.mark.parametrize("mode", ["residual", "absolute"])
def test_offsets_undo_what_inertia_costs(make_env, robot, mode, rng):
    """`K u = M a`, with M as MuJoCo has it; the legs' actions are the policy's."""
    laws = UpperBodyConfig(LawConfig("cotap"), LawConfig("cotap"))
    env = make_env(2, robot=robot, upper_body=laws, randomization=RandomizationConfig(enabled=False))
    env.cfg.actions.upper_mode = mode
    acceleration = torch.randn(2, env.num_actions - env.num_lower, generator=rng)
    oracle = arm_oracle.InertiaFedForward(env, lambda _: torch.ones(2, env.num_actions))
    assert not oracle.offset(acceleration).any()  # no law has commanded anything yet
    env.step(torch.zeros(2, env.num_actions))
    actions = oracle({})
    assert actions[:, : env.num_lower].eq(1.0).all()
    assert actions[:, env.num_lower :].abs().max() > 0.0

    model, offset = env.sim.model, oracle.offset(acceleration)
    for i in range(2):
        data = mujoco.MjData(model)
        data.qpos[:] = env.sim.qpos[i].numpy()
        mujoco.mj_forward(model, data)
        whole = torch.zeros(model.nv, model.nv, dtype=torch.float64)
        mujoco.mj_fullM(model, data, whole.numpy())
        arms = whole[6 + env.num_lower :, 6 + env.num_lower :]
        torque = (arms @ acceleration[i].double()).reshape(env.upper_body.stiffness.shape[1:3])
        found = (env.upper_body.stiffness[i].double() @ offset[i].double().reshape(torque.shape).unsqueeze(-1)).squeeze(
            -1
        )
        torch.testing.assert_close(found, torque, rtol=2e-2, atol=2e-2)


def test_the_table_compares_robot_by_robot():
    def result(errors):
        return {
            "per_env": {"e_upper": errors, "stood": [True] * 4},
            "metrics": {"e_upper": {"mean": 0.1}},
            "num_falls": 0,
        }

    rows = arm_oracle.table({"reference": result([0.1, 0.2, 0.3, 0.4]), "inertia": result([0.08, 0.16, 0.24, 0.32])})
    assert "| reference | 0.1000 | - | 0 |" in rows
    assert "| inertia | 0.1000 | -20.0% [-20.0%,-20.0%] | 0 |" in rows


def test_bad_input_is_named(capsys):
    assert arm_oracle.main(["--checkpoint", "h1-base", "--num-envs", "0"]) == 2
    assert "num_envs" in capsys.readouterr().err
