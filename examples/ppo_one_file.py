"""Proximal policy optimisation in one file, read top to bottom, on the native vector environment.

    python examples/ppo_one_file.py

Nothing but gymnasium, numpy and torch. The environment resets a row in the step in which its episode ends (same_step). The
horizon counts as an end, so nothing is bootstrapped behind it.
"""

import argparse
import time

import gymnasium
import numpy as np
import torch
from torch import nn

parser = argparse.ArgumentParser(description="PPO against a gated Kalman filter")
parser.add_argument("--steps", type=int, default=600_000, help="decisions, over all environments")
parser.add_argument("--envs", type=int, default=512, help="environments in the batch")
parser.add_argument("--rollout", type=int, default=60, help="steps per environment and update")
parser.add_argument("--epochs", type=int, default=6, help="passes over a rollout")
parser.add_argument("--minibatch", type=int, default=3072, help="samples per gradient step")
parser.add_argument("--lr", type=float, default=2e-3, help="learning rate")
parser.add_argument("--gamma", type=float, default=0.99, help="discount")
parser.add_argument("--lam", type=float, default=0.95, help="GAE lambda")
parser.add_argument("--clip", type=float, default=0.2, help="clip range")
parser.add_argument("--seed", type=int, default=0, help="seed")
args = parser.parse_args()

torch.set_num_threads(1)
torch.manual_seed(args.seed)
envs = gymnasium.make_vec(
    "tailgate:tailgate/CarFollowing-v1", num_envs=args.envs, autoreset="same_step", scenario="gusty-stop-and-go-v0", defence="chi2_kf",
    action="mode", value=-3.0, interval=10, gamma=args.gamma, gap_shaping=0.0, error_shaping=0.0, horizon_ends=True,
    threat={"kinds": ["dos_jam", "fdi"], "fdi_bound": 3.0, "budget": 20},
)  # fmt: skip
features, actions = envs.single_observation_space.shape[0], int(envs.single_action_space.n)


def network(outputs: int, last_gain: float) -> nn.Sequential:
    layers = [nn.Linear(features, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)]
    for layer, gain in zip(layers[::2], (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


actor, critic = network(actions, 0.01), network(1, 1.0)
with torch.no_grad():
    actor[-1].bias[0] = np.log((actions - 1) * 19.0)  # begin with resting in 19 decisions of 20: a spent budget teaches nothing
optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=args.lr, eps=1e-5)

shape = (args.rollout, args.envs)
obs_buf = torch.zeros((*shape, features))
act_buf, logp_buf, rew_buf, val_buf = torch.zeros(shape, dtype=torch.long), torch.zeros(shape), torch.zeros(shape), torch.zeros(shape)
done_buf = torch.zeros(shape)

obs = torch.as_tensor(envs.reset(seed=args.seed * 1_000_000)[0])
started, ended, crashed = time.perf_counter(), 0, 0
for update in range(1, max(1, args.steps // (args.envs * args.rollout)) + 1):
    for t in range(args.rollout):
        with torch.no_grad():
            policy = torch.distributions.Categorical(logits=actor(obs))
            action = policy.sample()
            obs_buf[t], act_buf[t], logp_buf[t], val_buf[t] = obs, action, policy.log_prob(action), critic(obs).squeeze(1)
        following, reward, terminated, _, info = envs.step(action.numpy())
        rew_buf[t], done_buf[t] = torch.as_tensor(reward), torch.as_tensor(terminated)
        ended, crashed = ended + int(terminated.sum()), crashed + int((info["collided"] | info["rear_collided"]).sum())
        obs = torch.as_tensor(following)

    with torch.no_grad():  # generalised advantage estimation, backwards
        advantages, running, following_value = torch.zeros(shape), torch.zeros(args.envs), critic(obs).squeeze(1)
        for t in reversed(range(args.rollout)):
            alive = 1.0 - done_buf[t]
            delta = rew_buf[t] + args.gamma * alive * following_value - val_buf[t]
            running = delta + args.gamma * args.lam * alive * running
            advantages[t], following_value = running, val_buf[t]
        returns = advantages + val_buf

    flat = [x.reshape(-1, *x.shape[2:]) for x in (obs_buf, act_buf, logp_buf, advantages, returns)]
    for _ in range(args.epochs):
        for chosen in torch.randperm(len(flat[0])).split(args.minibatch):
            o, a, old, adv, ret = (x[chosen] for x in flat)
            policy = torch.distributions.Categorical(logits=actor(o))
            ratio = (policy.log_prob(a) - old).exp()
            adv = (adv - adv.mean()) / (adv.std() + 1e-8)
            surrogate = torch.min(ratio * adv, ratio.clamp(1 - args.clip, 1 + args.clip) * adv).mean()
            loss = -surrogate + 0.5 * (critic(o).squeeze(1) - ret).pow(2).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters()], 0.5)
            optimiser.step()

    if ended:
        steps = update * args.envs * args.rollout
        rate = steps / (time.perf_counter() - started)
        share = f"collisions in {100 * crashed / ended:5.1f} % of {ended} episodes"
        print(f"{steps / 1e6:6.2f} M steps  {rate / 1e3:5.0f} k steps/s  {share}", flush=True)
        ended = crashed = 0
envs.close()
