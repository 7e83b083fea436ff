"""Gymnasium's own checks, and that its two views of the environment are the environment."""

from __future__ import annotations

import math
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics, TransformObservation

import cotap  # noqa: F401 - registers the ids
from cotap.envs import HumanoidEnvConfig
from cotap.envs.gymnasium import HumanoidSingleEnv, HumanoidVectorEnv
from cotap.envs.observations import NoiseConfig, ObservationConfig
from cotap.envs.terminations import TerminationConfig
from cotap.robots import ROBOTS

SHORT = TerminationConfig(episode_s=0.1)
NOISY = ObservationConfig(noise=NoiseConfig(enabled=True))


@pytest.fixture
def vector(robot) -> HumanoidVectorEnv:
    return HumanoidVectorEnv(3, HumanoidEnvConfig(robot=robot, num_threads=1), terminations=SHORT)


def zeros(env) -> np.ndarray:
    return np.zeros(env.action_space.shape, dtype=np.float32)


def test_one_env_passes_gymnasiums_checks():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(Box observation space|symmetric and normalized).*")
        check_env(gymnasium.make("CoTaP/H1-v0", num_threads=1, observations=NOISY).unwrapped)


def test_another_robot_passes_gymnasiums_checks(robot):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(Box observation space|symmetric and normalized).*")
        check_env(HumanoidSingleEnv(HumanoidEnvConfig(robot=robot, num_threads=1)), skip_render_check=True)


def test_spaces_follow_the_robot(vector, any_spec):
    width = vector.envs.get_observations()["policy"].shape[1]
    assert vector.envs.spec.name == any_spec.name
    assert vector.single_observation_space.shape == (width,)
    assert vector.single_action_space.shape == (len(any_spec.joints),)
    assert float(vector.single_action_space.high.max()) == vector.envs.cfg.actions.clip


@pytest.mark.parametrize("name", [*ROBOTS])
def test_a_robot_by_its_id_is_that_robot(name):
    """Whatever robot a config names: the id says which."""
    cfg = HumanoidEnvConfig(robot="made-up", num_threads=1)
    env = gymnasium.make(f"CoTaP/{name.upper()}-v0", cfg=cfg).unwrapped
    assert env.envs.spec.name == name


def test_spaces_of_the_h1():
    env = gymnasium.make_vec("CoTaP/H1-v0", num_envs=4, num_threads=1)
    assert isinstance(env.unwrapped, HumanoidVectorEnv)
    assert env.num_envs == 4
    assert env.single_observation_space.shape == (430,)
    assert env.single_action_space.shape == (19,)
    assert env.observation_space.shape == (4, 430)
    assert env.action_space.shape == (4, 19)
    assert env.single_observation_space.dtype == env.single_action_space.dtype == np.float32
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.action_space.seed(0)
    observation, reward, termination, truncation, _ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert reward.shape == termination.shape == truncation.shape == (4,)
    assert termination.dtype == truncation.dtype == bool


def test_is_the_environment(make_env, robot):
    vector = HumanoidVectorEnv(3, robot=robot, num_threads=1, seed=4)
    envs = make_env(3, robot=robot, seed=4)
    # The constructor resets, and so does a first reset without a seed.
    observation, _ = vector.reset()
    np.testing.assert_array_equal(observation, envs.reset()["policy"])
    rng = torch.Generator().manual_seed(0)
    ended = 0
    for _ in range(80):
        action = 2.0 * torch.randn(3, envs.num_actions, generator=rng)
        observation, reward, termination, truncation, infos = vector.step(action.numpy())
        expected, expected_reward, done, extras = envs.step(action)
        np.testing.assert_array_equal(observation, expected["policy"])
        np.testing.assert_allclose(reward, expected_reward)
        np.testing.assert_array_equal(termination, extras["falls"])
        np.testing.assert_array_equal(truncation, extras["time_outs"])
        np.testing.assert_array_equal(infos["group_rewards"], extras["group_rewards"])
        ended += int(done.sum())
    assert ended


def test_truncations_and_terminations_are_told_apart(vector):
    vector.reset(seed=0)
    vector.envs.sim.qpos[1, 3:7] = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])
    _, _, termination, truncation, _ = vector.step(zeros(vector))
    assert termination.tolist() == [False, True, False]
    assert not truncation.any()
    for _ in range(4):
        _, _, termination, truncation, _ = vector.step(zeros(vector))
    assert truncation.tolist() == [True, False, True]
    assert not termination.any()


def test_final_observation_is_the_ended_episodes_last(robot):
    short, long = (
        HumanoidVectorEnv(
            2, robot=robot, num_threads=1, observations=NOISY, terminations=TerminationConfig(episode_s=s)
        )
        for s in (0.1, 10.0)
    )
    short.reset(seed=3)
    long.reset(seed=3)
    action = zeros(short) + np.float32(0.2)
    for step in range(5):
        observation, _, _, truncation, infos = short.step(action)
        goes_on, *_ = long.step(action)
        assert truncation.all() == (step == 4)
        assert ("final_obs" in infos) == (step == 4)
    assert infos["_final_obs"].tolist() == [True, True]
    # Sensor noise of the last observation is drawn apart; all that is not noisy is the same as in the longer episode.
    final = np.stack(infos["final_obs"])
    assert final.dtype == np.float32
    terms = short.envs.observer.history.terms
    names = np.repeat([name for name, _, _ in terms], [5 * width for _, width, _ in terms])
    exact = ~np.isin(names, ["torso_angular_velocity", "projected_gravity", "joint_position", "joint_velocity"])
    np.testing.assert_allclose(final[:, exact], goes_on[:, exact], atol=1e-5)
    assert 50 < exact.sum() < final.shape[1] - 50
    np.testing.assert_allclose(final, goes_on, atol=0.11)
    assert np.abs(observation - goes_on).max() > 0.5
    assert infos["final_info"]["diverged"].tolist() == [False, False]


def test_taking_the_final_observation_leaves_no_trace(make_env, robot):
    vector = HumanoidVectorEnv(2, robot=robot, num_threads=1, terminations=SHORT, observations=NOISY)
    envs = make_env(2, robot=robot, terminations=SHORT, observations=NOISY)
    vector.reset()
    envs.reset()
    for _ in range(12):
        observation, *_ = vector.step(zeros(vector))
        expected, *_ = envs.step(torch.zeros(2, envs.num_actions))
        np.testing.assert_array_equal(observation, expected["policy"])


@pytest.mark.usefixtures("in_tmp_path")
def test_a_single_env_says_that_it_diverged(robot):
    env = HumanoidSingleEnv(robot=robot, num_threads=1)
    env.reset(seed=0)
    before, _, _, _, info = env.step(zeros(env))
    assert info["diverged"] is False
    env.envs.sim.qpos[0, 9] = math.nan
    observation, reward, terminated, truncated, info = env.step(zeros(env))
    assert (reward, terminated, truncated, info["diverged"]) == (0.0, True, False, True)
    np.testing.assert_array_equal(observation, before)
    env.reset()
    *_, info = env.step(zeros(env))
    assert info["diverged"] is False


@pytest.mark.usefixtures("in_tmp_path")
def test_a_diverged_envs_final_observation_is_the_one_before(vector):
    vector.reset(seed=0)
    before, *_ = vector.step(zeros(vector))
    vector.envs.sim.qpos[1, 9] = math.nan
    observation, reward, termination, _, infos = vector.step(zeros(vector))
    assert termination.tolist() == infos["final_info"]["diverged"].tolist() == [False, True, False]
    np.testing.assert_array_equal(infos["final_obs"][1], before[1])
    assert infos["final_obs"][0] is None
    assert np.isfinite(observation).all()
    assert reward[1] == 0.0


def test_a_seed_decides_everything(vector):
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(30, *vector.action_space.shape)).astype(np.float32)

    def run(seed):
        observation, _ = vector.reset(seed=seed)
        return np.stack([observation, *(vector.step(a)[0] for a in actions)])

    first, other, again = run(5), run(6), run(5)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first[0] - other[0]).max() > 0.01


def test_reset_without_a_seed_goes_on_with_new_episodes(vector):
    first, _ = vector.reset(seed=5)
    second, _ = vector.reset()
    assert np.abs(first - second).max() > 0.01


def test_returned_arrays_are_the_callers(vector):
    observation, _ = vector.reset(seed=0)
    observation[:] = 1e6
    action = zeros(vector)
    following, *_ = vector.step(action)
    assert np.abs(following).max() < 1e3
    assert not action.any()
    following[:] = 1e6
    assert np.abs(vector.step(action)[0]).max() < 1e3


def test_one_env_shows_its_last_observation_at_the_end(robot):
    cfg = HumanoidEnvConfig(robot=robot, num_threads=1, terminations=SHORT)
    single, vector = HumanoidSingleEnv(cfg), HumanoidVectorEnv(1, cfg)
    single.reset(seed=2)
    vector.reset(seed=2)
    for step in range(5):
        observation, reward, terminated, truncated, info = single.step(zeros(single))
        _, rewards, _, _, infos = vector.step(zeros(vector))
        assert reward == pytest.approx(float(rewards[0]))
        assert not terminated
        assert info["diverged"] is False
        np.testing.assert_array_equal(info["group_rewards"], infos["group_rewards"][0])
        assert truncated == (step == 4)
    np.testing.assert_array_equal(observation, infos["final_obs"][0])


def test_gymnasiums_statistics_wrapper_works(vector):
    env = RecordEpisodeStatistics(vector)
    env.reset(seed=0)
    total = np.zeros(3)
    for _ in range(5):
        _, reward, _, truncation, infos = env.step(zeros(vector))
        total += reward
    assert truncation.all()
    np.testing.assert_allclose(infos["episode"]["r"], total, atol=1e-6)
    assert infos["episode"]["l"].tolist() == [5, 5, 5]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_mask_restarts_its_envs_and_leaves_the_others_alone(robot, mode):
    """The others go on as if nothing had been; there is no noise here, and no other random numbers."""
    still = {"robot": robot, "num_threads": 1, "autoreset_mode": mode}
    masked, plain = HumanoidVectorEnv(3, **still), HumanoidVectorEnv(3, **still)
    for env in (masked, plain):
        env.reset(seed=0)
        for _ in range(3):
            before, *_ = env.step(zeros(env) + np.float32(0.2))
    mask = np.array([False, True, False])
    observation, infos = masked.reset(options={"reset_mask": mask})
    assert infos == {}
    np.testing.assert_array_equal(observation[~mask], before[~mask])
    assert np.abs(observation[mask] - before[mask]).max() > 0.1
    assert masked.envs.episode_length_buf.tolist() == [3, 0, 3]
    for _ in range(3):
        seen, expected = (env.step(zeros(env))[0] for env in (masked, plain))
        np.testing.assert_allclose(seen[~mask], expected[~mask], atol=1e-5)


def test_ended_envs_restart_in_the_next_step_where_that_is_asked_for(robot):
    cfg = HumanoidEnvConfig(robot=robot, num_threads=1, terminations=SHORT)
    same, following = HumanoidVectorEnv(2, cfg), HumanoidVectorEnv(2, cfg, autoreset_mode="NextStep")
    assert following.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    for env in (same, following):
        env.reset(seed=3)
    following.envs.episode_length_buf[1] = -3  # its episode is longer
    for _ in range(5):
        _, _, _, _, infos = same.step(zeros(same))
        last, reward, _, truncation, own = following.step(zeros(following))
    assert truncation.tolist() == [True, False]
    np.testing.assert_array_equal(last[0], infos["final_obs"][0])
    assert "final_obs" not in own
    assert own["diverged"].tolist() == [False, False]
    assert reward[0] != 0.0
    with pytest.raises(ValueError, match=r"actions must have shape .*, got \(2,\)"):
        following.step(np.zeros(2))  # as many as envs, of which one restarts
    actions = zeros(following)
    actions[0] = np.nan  # of an env that restarts no action is asked
    first, reward, termination, truncation, infos = following.step(actions)
    assert not (termination | truncation).any()
    assert (reward[0], infos["group_rewards"][0].tolist()) == (0.0, [0.0, 0.0])
    assert reward[1] != 0.0
    assert following.envs.episode_length_buf.tolist() == [0, 3]
    np.testing.assert_array_equal(first, following.envs.get_observations()["policy"])
    width, steps = following.envs.observer.history.width, following.envs.observer.history.steps
    np.testing.assert_array_equal(first[0, :3], first[0, 3 * (steps - 1) : 3 * steps])  # a history of one moment
    assert first.shape == (2, width * steps)
    for _ in range(4):
        *_, truncation, _ = following.step(zeros(following))
    assert truncation.tolist() == [False, False]
    *_, truncation, _ = following.step(zeros(following))
    assert truncation.tolist() == [True, False]


def test_without_autoreset_the_caller_restarts(robot):
    env = HumanoidVectorEnv(2, robot=robot, num_threads=1, terminations=SHORT, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    for _ in range(5):
        last, _, _, truncation, _ = env.step(zeros(env))
    first, _ = env.reset(options={"reset_mask": truncation})
    assert np.abs(first - last).max() > 0.1
    assert not env.step(zeros(env))[3].any()


@pytest.mark.parametrize("wrapper", [NormalizeObservation, lambda env: TransformObservation(env, lambda o: 2.0 * o)])
def test_gymnasiums_observation_wrappers_take_the_next_step_mode(robot, wrapper):
    env = wrapper(HumanoidVectorEnv(2, robot=robot, num_threads=1, terminations=SHORT, autoreset_mode="NextStep"))
    env.reset(seed=0)
    for _ in range(8):
        observation, *_ = env.step(zeros(env))
    assert np.isfinite(observation).all()


@pytest.mark.parametrize(
    ("options", "seed", "message"),
    [
        ({"reset_mask": np.array([True, False])}, None, r"of shape \(3,\), got bool of \(2,\)"),
        ({"reset_mask": np.array([1, 0, 0])}, None, "array of bool .*, got int64"),
        ({"reset_mask": [True, False, False]}, None, r"array of bool .*, got \[True"),
        ({"reset_mask": np.zeros(3, dtype=bool)}, None, "one env at least"),
        ({"reset_mask": np.ones(3, dtype=bool)}, 4, "goes without a seed, got 4"),
        ({"mask": None}, None, "reset knows no option 'mask'; known: reset_mask"),
    ],
)
def test_options_that_cannot_be_are_refused(vector, options, seed, message):
    with pytest.raises(ValueError, match=message):
        vector.reset(seed=seed, options=options)


def test_a_mode_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="autoreset_mode 'Never' is unknown; known: Disabled, NextStep, SameStep"):
        HumanoidVectorEnv(1, autoreset_mode="Never")
    with pytest.raises(ValueError, match="reset knows no option 'reset_mask'; known: none"):
        HumanoidSingleEnv(num_threads=1).reset(options={"reset_mask": np.ones(1, dtype=bool)})


def test_gymnasiums_own_vectors_take_it():
    env = gymnasium.make_vec("CoTaP/H1-v0", num_envs=2, vectorization_mode="sync", num_threads=1)
    observation, _ = env.reset(seed=1)
    assert observation.shape == (2, 430)
    assert np.abs(observation[0] - observation[1]).max() > 0.01
    env.close()


def test_the_callers_config_is_left_alone():
    cfg = HumanoidEnvConfig(num_envs=64, num_threads=1)
    env = HumanoidVectorEnv(2, cfg, control_dt=0.04)
    assert env.num_envs == env.envs.num_envs == 2
    assert env.envs.dt == pytest.approx(0.04)
    assert cfg == HumanoidEnvConfig(num_envs=64, num_threads=1)
    assert env.envs.cfg.commands is not cfg.commands


def test_bad_input_is_refused(vector):
    with pytest.raises(ValueError, match=r"field of HumanoidEnvConfig 'num_env' is unknown .*known: actions, assist"):
        HumanoidSingleEnv(num_env=3)
    with pytest.raises(ValueError, match="num_envs must be a positive integer, got 0"):
        HumanoidVectorEnv(0)
    vector.reset(seed=0)
    with pytest.raises(ValueError, match="actions must be finite, got nan"):
        vector.step(zeros(vector) + np.nan)
    joints = vector.action_space.shape[1]
    with pytest.raises(ValueError, match=rf"actions must have shape \(3, {joints}\), got \({joints},\)"):
        vector.step(np.zeros(joints))
