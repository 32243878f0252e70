"""DAgger of HumanCompatibleAI/imitation on PickCube-v1 with the expert, the labels and the rounds of pick_cube.py.

pip install --target LIB --no-deps imitation stable-baselines3 datasets sacred huggingface_sb3 pandas pyarrow dill
    multiprocess xxhash wrapt munch GitPython gitdb py-cpuinfo colorama jsonpickle huggingface_hub httpx httpcore h11
    anyio tzdata pytz
PYTHONPATH=.:tests/examples:LIB python tests/examples/imitation_dagger.py SEED [CHECKPOINT]

With CHECKPOINT, of a run of launch/train.py with algo.learner.history=0, that is measured in the same episodes.
"""

from __future__ import annotations

import json
import pickle
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import mani_skill.envs  # noqa: F401, it registers the tasks
import numpy as np
import pick_cube
import torch
from imitation.algorithms.bc import BC
from imitation.algorithms.dagger import ExponentialBetaSchedule, SimpleDAggerTrainer
from imitation.data import serialize
from imitation.data.wrappers import RolloutInfoWrapper
from imitation.util.logger import configure
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.vec_env import DummyVecEnv
from tensordict import TensorDict

from fb3d_rl.algos.task import load_learner
from fb3d_rl.env.any_task import state_of


class Task(gymnasium.Env):
    """PickCube-v1 as imitation wants it: the state that fb3d_rl's learner sees, an episode that ends with success."""

    def __init__(self, seeds):
        self.env = gymnasium.make(
            "PickCube-v1", obs_mode="state_dict", render_backend="none", num_envs=1, sim_backend="physx_cpu",
            reconfiguration_freq=1, control_mode="pd_ee_delta_pos",
        )  # fmt: skip
        self.expert, self.seeds, self.steps, self.won = pick_cube.make(self.env), iter(seeds), 0, []
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self.env.action_space.shape, np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, self.reset(seed=0)[0].shape, np.float32)

    def reset(self, *, seed=None, options=None):
        obs, _ = self.env.reset(seed=next(self.seeds) if seed is None else seed)
        return self.seen(obs), {}

    def seen(self, obs):
        self.label = np.asarray(self.expert(obs), dtype=np.float32).clip(-1, 1)
        return state_of(obs)[0].numpy()

    def step(self, action):
        obs, reward, ended, cut, info = self.env.step(np.asarray(action)[None])
        if ended or cut:
            self.won.append(bool(info["success"].any()))
        return self.seen(obs), float(reward), bool(ended), bool(cut), {}


class Expert(BasePolicy):
    """What the task's expert says about the state that it is in."""

    def __init__(self, task):
        super().__init__(task.observation_space, task.action_space)
        self.task = task

    def _predict(self, observation, deterministic=False):
        return torch.from_numpy(self.task.label)[None]


def save(path, trajectories):
    """As imitation's own, but by pickle, which it reads too: with today's dill its library cannot write them."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(pickle.dumps(list(trajectories)))


serialize.save = save


def trained(task, labels, rounds, epochs, seed):
    """imitation's policy after DAgger with so many labels."""
    torch.manual_seed(seed)  # noqa: TID251, the library draws from it
    venv, rng = DummyVecEnv([lambda: RolloutInfoWrapper(task)]), np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        policy = ActorCriticPolicy(task.observation_space, task.action_space, lambda _: 1e-3, net_arch=[256, 256])
        quiet = configure(folder, format_strs=[])
        space = {"observation_space": task.observation_space, "action_space": task.action_space}
        bc = BC(**space, rng=rng, policy=policy, batch_size=64, device="cpu", custom_logger=quiet)
        trainer = SimpleDAggerTrainer(
            venv=venv, scratch_dir=folder, expert_policy=Expert(task), rng=rng, bc_trainer=bc,
            beta_schedule=ExponentialBetaSchedule(0.7), custom_logger=quiet,
        )  # fmt: skip
        batches = epochs * labels // 64 // rounds
        trainer.train(labels, rollout_round_min_episodes=1, rollout_round_min_timesteps=labels // rounds,
                      bc_train_kwargs={"n_batches": batches, "progress_bar": False})  # fmt: skip
    return lambda obs: policy.predict(obs, deterministic=True)[0]


def loaded(checkpoint):
    """The policy of a run of launch/train.py with algo.learner.history=0."""
    learner = load_learner(checkpoint)
    return lambda obs: learner(TensorDict({"observation": {"state": torch.from_numpy(obs)[None]}}, [1]))["action"][0]


def main(*words, labels=1600, rounds=4, epochs=60, episodes=50):
    seed, checkpoint = int(words[0]), words[1] if len(words) > 1 else None
    task = Task(np.random.default_rng([seed, 5]).integers(2**31, size=10**6).tolist())
    act = loaded(checkpoint) if checkpoint else trained(task, labels, rounds, epochs, seed)
    seconds, taken = time.process_time(), len(task.won)
    task.seeds, rewards = iter(np.random.default_rng([seed, 10]).integers(2**31, size=episodes).tolist()), []
    for _ in range(episodes):
        obs, over, total = task.reset()[0], False, 0.0
        while not over:
            obs, reward, ended, cut, _ = task.step(act(obs))
            total, over = total + reward, ended or cut
        rewards.append(total)
    won = task.won[taken:]
    print(json.dumps({"success": sum(won), "episodes": len(won), "reward an episode": round(np.mean(rewards), 2),
                      "CPU s until trained": round(seconds, 1)}))  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:])
