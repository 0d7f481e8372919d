"""Batches from the environments of gymnax, Brax and EnvPool, as their own documentation steps them."""

from __future__ import annotations

import json

import envpool
import gymnax
import jax
import numpy as np

import runner
from runner.execution.verify import verify

N, STEPS = 6, 400


def recorded_steps(run):
    """Return the training steps of a finished run as one array, [T, N]."""
    assert verify(run.recording).finding == ""
    with runner.open_recording(run.recording) as recording:
        steps = recording.train.steps.array()
        return steps.reshape(-1, N), json.loads(recording.run["spaces"])


def test_a_scan_over_gymnax(recordings):
    env, params = gymnax.make("CartPole-v1")
    step_all = jax.vmap(env.step, in_axes=(0, 0, 0, None))

    def rollout(key, observation, state):
        def step(carry, key):
            keys = jax.random.split(key, N)
            action = jax.vmap(env.action_space(params).sample)(keys)
            after, state, reward, terminated, truncated, info = step_all(keys, carry[1], action, params)
            own = carry[0], action, reward, terminated, truncated, info["final_observation"]
            return (after, state), own

        (last, state), trajectory = jax.lax.scan(step, (observation, state), jax.random.split(key, STEPS))
        return last, state, trajectory

    keys = jax.random.split(jax.random.PRNGKey(0), N)
    last, state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    batches = []
    with runner.record_batches(
        "gymnax/CartPole-v1",
        recordings,
        observation_space=env.observation_space(params),
        action_space=env.action_space(params),
        autoreset_mode="SameStep",
    ) as rec:
        for update in range(3):
            last, state, batch = jax.jit(rollout)(jax.random.PRNGKey(update), last, state)
            observations, *others, final = batch
            observations = jax.numpy.concatenate([observations, last[None]])
            rec.batch(observations, *others, final_observations=final)
            batches.append([np.asarray(each) for each in batch])
    steps, spaces = recorded_steps(rec.run)
    _, action, reward, terminated, truncated, final = (
        np.concatenate(each) for each in zip(*batches, strict=True)
    )
    assert spaces["action"]["type"] == "Discrete"
    assert (steps["action"] == action).all()
    assert (steps["rewards"][..., 0] == reward).all()
    assert (steps["terminated"] == terminated).all()
    assert (steps["next_observation"] == final).all()  # gymnax gives the observation before any reset
    assert rec.run.summary.episodes == (terminated | truncated).sum() > 50


def test_brax_resets_within_its_steps(recordings):
    from brax import envs  # it warns when it is imported

    env = envs.create("fast", episode_length=25, auto_reset=True, batch_size=N)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))

    def step(state, key):
        action = jax.random.uniform(key, (N, env.action_size), minval=-1)
        after = env.step(state, action)
        return after, (after.obs, action, after.reward, after.done, after.info["truncation"])

    first = state.obs
    keys = jax.random.split(jax.random.PRNGKey(1), STEPS)
    _, (obs, action, reward, done, cut) = jax.lax.scan(step, state, keys)
    with runner.record_batches("brax/fast", recordings, autoreset_mode="SameStep") as rec:
        rec.reset(first)
        rec.batch(obs, action, reward, done * (1 - cut), cut, final_observations=obs)
    steps, _ = recorded_steps(rec.run)
    assert (steps["action"] == np.asarray(action)).all()
    assert (steps["truncated"] == (np.asarray(cut) == 1)).all()
    assert rec.run.summary.episodes == np.asarray(done).sum() > 0


def test_envpool_gives_the_same_content_in_batches_as_step_by_step(recordings):
    digests = []
    for in_batches in (False, True):
        envs = envpool.make_gymnasium("CartPole-v1", num_envs=N, seed=3)
        actions = np.random.default_rng(0).integers(0, 2, (STEPS, N))
        if in_batches:
            with runner.record_batches(envs, recordings) as rec:
                rec.reset(envs.reset()[0])
                rows = [envs.step(action)[:4] for action in actions]
                observations, rewards, terminated, truncated = map(np.array, zip(*rows, strict=True))
                rec.batch(observations, actions, rewards, terminated, truncated)
        else:
            with runner.record_vector(envs, recordings) as rec:
                rec.reset()
                for action in actions:
                    rec.step(action)
        assert rec.run.summary.episodes > 20
        digests.append(rec.run.summary.topic_digests)
    assert digests[0] == digests[1]
