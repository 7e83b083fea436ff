"""One option, one meaning, one default, whatever the protocol; and none that does nothing."""

from __future__ import annotations

from dataclasses import MISSING, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint
from cotap.compliance.interface import ArmState, LawParameters
from cotap.compliance.laws import LAWS, READS, LawConfig, reads
from cotap.configs import to_plain
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluate import PROTOCOLS, arms_of, main, parse, usage
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.policy import load_policy
from cotap.evaluation.scenario import MODES
from cotap.robots import ROBOTS
from cotap.robots.chains import arm_model
from release.publish import EVALUATIONS
from reports.paper.arms import arms

EVERYWHERE: dict[str, Any] = {"seed": 0, "torque_limit_scale": 1.0, "randomize": True}
"""Options of all protocols beside `num_envs`, and their defaults."""
ON_LEGS: dict[str, Any] = {"mode": "stance", "speed": 0.5, "pelvis": "free", "unevenness": 0.0}
OF_ARMS: dict[str, Any] = {"upper_actions": "policy", "arm_pose": (), "library": "", "hand": "left"}
TABLE = EVERYWHERE | ON_LEGS | OF_ARMS
OTHERWISE: dict[str, dict[str, Any]] = {
    "static-stiffness": {"pelvis": "fixed", "upper_actions": "reference", "randomize": False},
    "fidelity": {"randomize": False},
    "stability": {"randomize": False},
    "passivity": {"pelvis": "fixed", "upper_actions": "reference", "randomize": False},
    "periodic-load": {"hand": "both"},
    "tour": {"upper_actions": "reference", "randomize": False},
}
"""Defaults that differ, as docs/evaluation.md says."""
WITHOUT: dict[str, set[str]] = {
    "velocity-tracking": {*ON_LEGS, "hand"},  # draws its commands; loads both hands
    "stability": {*ON_LEGS, *OF_ARMS},  # a law alone, in the air, at random poses, both hands loaded
    "passivity": {"library", "arm_pose", "hand"},  # draws its poses; pulls the left hand
    "static-stiffness": {"library"},  # holds one pose
    "fidelity": {"arm_pose"},  # draws its poses from a library
    "task": {*ON_LEGS, "hand"},  # draws its commands, loads and pushes
    "tour": {*ON_LEGS, "arm_pose", "library", "hand"},  # walks, its arms wander, any joint is struck
}
"""What a protocol cannot have."""


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_an_option_has_one_name_and_one_default(protocol):
    options = {f.name: f.default for f in fields(PROTOCOLS[protocol])}
    wanted = {k: v for k, v in TABLE.items() if k not in WITHOUT.get(protocol, ())} | OTHERWISE.get(protocol, {})
    assert {name: options[name] for name in wanted} == wanted
    assert not WITHOUT.get(protocol, set()) & options.keys()
    assert "num_envs" in options
    # How long an evaluation takes, how many robots there are and what stiffness is tried have one name.
    assert not {"seconds", "repeats", "worlds", "stiffness_levels"} & options.keys()
    assert MISSING not in options.values()
    assert len(options.get("force", (0.0, 0.0, 0.0))) == 3  # along the axes; the size of one is `force_size`


@pytest.mark.parametrize("motion", [("none",), ("mixture",)])
@pytest.mark.parametrize(
    ("name", "mode"),
    list(product(("impact", "constant-load", "periodic-load", "fall-curve", "modulation"), MODES)),
)
def test_robots_are_asked_to_stand_or_to_walk(name, motion, mode):
    """Whatever else a protocol prepares."""
    walking = {"speed": 0.4} if mode == "walking" else {}
    protocol = PROTOCOLS[name](num_envs=16, motion=motion, mode=mode, **walking)
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap").configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    for _ in range(250):
        env.commands.step(env.rng)
    expected = torch.tensor([0.4 if mode == "walking" else 0.0, 0.0, 0.0])
    torch.testing.assert_close(env.commands.asked_velocity, expected.expand(16, 3))
    assert (env.commands.asked_to_stand == (mode == "stance")).all()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_evaluation_can_be_filmed(protocol):
    assert parse([protocol, "--video", "film.mp4"]).video == "film.mp4"


@pytest.mark.parametrize(
    "arguments", [*EVALUATIONS.values(), *(["impact", *law] for robot in ROBOTS for law in arms(robot).values())]
)
def test_what_the_reports_ask_for_is_understood(arguments):
    options = parse([a if a != "ENVS" else "16" for a in arguments])
    options.protocol.check()
    options.laws.configure()


def test_the_help_says_what_each_protocol_is_for(capsys):
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert usage() in shown
    for name in (*PROTOCOLS, "recording"):
        (line,) = (line for line in shown.splitlines() if line.startswith(f"  {name} "))
        assert len(line) > 40


@pytest.mark.parametrize("name", LAWS)
def test_a_law_reads_what_it_is_said_to_read(name, spec, rng):
    """Its torque depends on a field exactly if `READS` has it; sensing is the environment's."""
    arms = arm_model(spec)
    q = torch.tensor([0.1, 0.3, 0.2, 0.3, 0.1, -0.3, -0.2, 0.3]).reshape(1, 2, 4)
    pose, force = arms.chains.pose(q), torch.tensor([5.0, -3.0, 4.0]).expand(1, 2, 3)
    state = ArmState(
        q, torch.randn(q.shape, generator=rng), q + 0.1 * torch.randn(q.shape, generator=rng), pose,
        torch.eye(3).expand(1, 3, 3), None, force, torch.full_like(q, 0.2), torch.zeros(1, 2, dtype=torch.bool), 0.02,
    )  # fmt: skip

    def torque(**changed: Any) -> torch.Tensor:
        law = LawConfig(name, alpha=0.6)
        for field, value in changed.items():
            setattr(law, field, value)
        built, parameters = LAWS[name](arms, law), LawParameters(
            torch.tensor(law.stiffness).expand(1, 2, 3), torch.full((1, 2), law.null_stiffness),
            torch.full((1, 2), law.alpha),
        )  # fmt: skip
        for _ in range(2):  # a virtual mass moves in the first step
            answer, _ = built(state, parameters)
        return answer.at(q + 0.05, state.velocity)

    changes = {"stiffness": (100.0, 200.0, 900.0), "null_stiffness": 90.0, "alpha": 0.2, "condition_threshold": 1.0,
               "error": "task", "damping": "pd", "soft_gain": 60.0, "virtual_mass": 3.0, "damping_ratio": 0.3,
               "reference_share": 0.2}  # fmt: skip
    of_a_store = {"passive", "store_energy", "store_power"}  # seen once stiffness changes: tests/compliance
    of_a_pose = {"rotational_stiffness", "characteristic_length"}  # of longer arms: likewise
    assert {*changes, *of_a_store, *of_a_pose, "sensing", "name"} == {f.name for f in fields(LawConfig)}
    for field, value in changes.items():
        assert torch.equal(torque(), torque(**{field: value})) != reads(name, field), field
    assert READS.keys() == LAWS.keys()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["static-stiffness", "--stiffness", "500"], "--stiffness is not read by pd, the law here"),
        (["impact", "--method", "soft-pd", "--null-stiffness", "30"], "--null-stiffness is not read by soft-pd"),
        (["impact", "--method", "facet", "--alpha", "0.5"], "laws that read it: cotap, "),
        (["impact", "--torso-compliance", "constant"], "--torso-compliance is not read by pd"),
        (["impact", "--method", "facet", "--torso-compliance", "support"], "--torso-compliance is not read by facet"),
        (["impact", "--singularity-ratio", "False"], "--singularity-ratio is not read by pd"),
        (["impact", "--left", "pd", "--right", "facet", "--error", "task"], "--error is not read by facet and pd"),
        (["impact", "--method", "cotap", "--left", "pd", "--right", "hmc"], "--method does nothing beside"),
        (["impact", "--left", "cotap:alpha=0.5", "--alpha", "1"], "--alpha does nothing: --left and --right"),
        (["impact", "--passive"], "--passive is not read by pd, the law here; laws that read it: cotap"),
        (["impact", "--method", "cotap+facet", "--passive"], "--passive is not read by cotap+facet"),
        (["impact", "--left", "cotap:passive=yes"], "--left: passive 'yes' is unknown; known: false, true"),
        (["impact", "--left", "facet:alpha=0.5"], "--left: facet does not read alpha; it reads: stiffness, "),
        (["impact", "--right", "pd:stiffness=3"], "--right: pd does not read stiffness; it reads: nothing"),
        (["fidelity", "--stiffness", "500"], "--stiffness does nothing here: the protocol sets it, see --stiffness-v"),
        (["fidelity", "--left", "cotap:stiffness=500"], "--stiffness does nothing here"),
        (["modulation", "--alpha", "0.5"], "see --alpha-range"),
        (["modulation", "--method", "facet", "--alpha-range", "0", "0.5"], "alpha_range does nothing under facet"),
        (["impact", "--speed", "1"], "speed does nothing in stance"),
        (["impact", "--place", "base", "--hand", "right"], "hand does nothing for a force on the base"),
        (["impact", "--pelvis", "fixed", "--place", "base"], "place does nothing while the pelvis is fixed"),
        (["constant-load", "--random-direction"], "random_direction does nothing for a force along z alone"),
        (["velocity-tracking", "--follow-path", "--speed-x", "0.5"], "speed_x does nothing while a path is followed"),
        (["impact", "--pelvis", "fixed", "--mode", "walking"], "mode does nothing while the pelvis is fixed"),
        (["static-stiffness", "--mode", "walking"], "mode does nothing while the pelvis is fixed"),
        (["constant-load", "--library", "x.npz"], "library does nothing while arms hold a pose"),
        (["tour", "--stiffness", "300"], "--stiffness is not read by pd, the law here"),
        (["velocity-tracking", "--arm-pose", "0", "0", "0", "0"], "held only with motion 'none'"),
    ],
)
@pytest.mark.usefixtures("shipped")
def test_an_option_that_does_nothing_is_refused_by_name(arguments, message, capsys):
    assert main([*arguments, "--num-envs", "11"]) == 2
    assert message in capsys.readouterr().err


@pytest.fixture
def distilled(tmp_path, save) -> Path:
    """A policy of the second stage, trained under CoTaP."""
    law = UpperBodyConfig(LawConfig("cotap", null_stiffness=33.0), LawConfig("cotap", null_stiffness=33.0))
    path = save(tmp_path / "p.pt", HumanoidEnvConfig(num_envs=1, num_threads=1, upper_body=law))
    save_checkpoint(path, load_checkpoint(path) | {"kind": "distill"})
    return path


def test_another_law_keeps_what_the_policy_was_trained_with():
    """The paper's damping and the hand's error stay under CoTaP + FACET, and stiffness under FACET alone."""
    law = LawConfig("cotap", (500.0, 500.0, 300.0), 25.0, 0.7, error="task", damping="pd")
    trained = UpperBodyConfig(law, law)
    for name in ("cotap+facet", "facet"):
        arms = LawOptions(method=name).configure(trained)
        assert arms.left == arms.right == replace(law, name=name)
    assert LawOptions(left="cotap+facet", right="pd").configure(trained).left == replace(law, name="cotap+facet")
    told = LawOptions(method="cotap+facet", error="joint", stiffness=(200.0,)).configure(trained)
    assert told.left == replace(law, name="cotap+facet", error="joint", stiffness=(200.0,) * 3)
    # A policy that was trained under PD has nothing to keep.
    assert LawOptions(method="cotap+facet").configure(UpperBodyConfig()).left == LawConfig("cotap+facet")


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_law_of_the_training_is_the_default_of_every_evaluation(protocol, distilled, checkpoint):
    policy = load_policy(distilled)
    if PROTOCOLS[protocol].laws_for_all:  # a yardstick, whatever the policy was trained under
        assert arms_of(parse([protocol]), policy).left.name == arms_of(parse([protocol]), policy).right.name == "pd"
        return
    arms = arms_of(parse([protocol]), policy)
    assert to_plain(arms.left) == to_plain(arms.right) == to_plain(policy.env_config.upper_body.left)
    if not {"stiffness"} & PROTOCOLS[protocol].drives.keys():
        softer = arms_of(parse([protocol, "--stiffness", "500"]), policy)
        assert softer.left.stiffness == softer.right.stiffness == (500.0,) * 3
    # A policy of the first stage has PD, or the law that the protocol is about.
    own = arms_of(parse([protocol]), load_policy(checkpoint))
    named = {
        "fidelity": ("cotap", "cotap"),
        "modulation": ("cotap", "cotap"),
        "passivity": ("cotap", "cotap"),
        "task": ("cotap", "cotap"),
        "periodic-load": ("cotap", "pd"),
    }
    assert (own.left.name, own.right.name) == named.get(protocol, ("pd", "pd"))
    assert arms_of(parse(["periodic-load", "--method", "cotap"]), load_policy(checkpoint)).left == LawConfig("cotap")


def test_a_store_is_for_the_arms_whose_law_can_have_one(distilled):
    policy = load_policy(distilled)
    for arguments, passive in (
        ([], (False, False)),
        (["--passive"], (True, True)),
        (["--passive", "--right", "pd"], (True, False)),
        (["--left", "cotap:passive=true,store_energy=0.5"], (True, False)),
        (["--passive", "--left", "cotap:passive=false"], (False, True)),
    ):
        arms = arms_of(parse(["impact", *arguments]), policy)
        assert (arms.left.passive, arms.right.passive) == passive, arguments
    trained = UpperBodyConfig(LawConfig("cotap", passive=True), LawConfig("cotap", passive=True))
    assert LawOptions().configure(trained).left.passive  # as in the training
    assert not LawOptions(method="pd").configure(trained).left.passive
    with pytest.raises(ValueError, match=r"upper_body\.left\.passive: pd has no energy store"):
        UpperBodyConfig(LawConfig("pd", passive=True)).check()
