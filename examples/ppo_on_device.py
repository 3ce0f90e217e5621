"""Proximal policy optimisation in one file, wholly in tensors: environments, networks and rollouts on one device.

    python examples/ppo_on_device.py --device cuda

With --device cuda nothing but a few counters leaves the card (needs tailgate[cuda] and PyTorch for CUDA). The algorithm and its numbers
are those of ppo_one_file.py, with more environments where a card has room for them.
"""

import argparse
import math
import time

import torch
from torch import nn

from tailgate.envs.torch import TensorVecEnv

parser = argparse.ArgumentParser(description="PPO against a gated Kalman filter, on one device")
parser.add_argument("--device", default="cpu", help="cpu or cuda")
parser.add_argument("--steps", type=int, default=600_000, help="decisions, over all environments")
parser.add_argument("--envs", type=int, default=512, help="environments in the batch")
parser.add_argument("--rollout", type=int, default=60, help="steps per environment and update")
parser.add_argument("--epochs", type=int, default=6, help="passes over a rollout")
parser.add_argument("--minibatches", type=int, default=10, help="gradient steps per pass")
parser.add_argument("--lr", type=float, default=2e-3, help="learning rate")
parser.add_argument("--gamma", type=float, default=0.99, help="discount")
parser.add_argument("--lam", type=float, default=0.95, help="GAE lambda")
parser.add_argument("--clip", type=float, default=0.2, help="clip range")
parser.add_argument("--seed", type=int, default=0, help="seed")
args = parser.parse_args()

torch.manual_seed(args.seed)
if args.device == "cpu":
    torch.set_num_threads(1)
envs = TensorVecEnv(
    args.envs, device=args.device, autoreset="same_step", scenario="gusty-stop-and-go-v0", defence="chi2_kf",
    action="mode", value=-3.0, interval=10, gamma=args.gamma, gap_shaping=0.0, error_shaping=0.0, horizon_ends=True,
    threat={"kinds": ["dos_jam", "fdi"], "fdi_bound": 3.0, "budget": 20},
)  # fmt: skip
device, features, actions = envs.device, envs.single_observation_space.shape[0], int(envs.single_action_space.n)


def network(outputs: int, last_gain: float) -> nn.Sequential:
    layers = [nn.Linear(features, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)]
    for layer, gain in zip(layers[::2], (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


def chosen(logits: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """The logarithm of the probability of the actions taken."""
    return logits.log_softmax(dim=1).gather(1, action[:, None]).squeeze(1)


actor, critic = network(actions, 0.01).to(device), network(1, 1.0).to(device)
with torch.no_grad():
    actor[-1].bias[0] = math.log((actions - 1) * 19.0)  # begin with resting in 19 decisions of 20: a spent budget teaches nothing
optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=args.lr, eps=1e-5)

shape = (args.rollout, args.envs)
observations = torch.zeros((*shape, features), device=device)
taken = torch.zeros(shape, dtype=torch.long, device=device)
before, rewards, values, ends = (torch.zeros(shape, device=device) for _ in range(4))

observation, _ = envs.reset(seed=args.seed * 1_000_000)
started, updates = time.perf_counter(), max(1, args.steps // (args.envs * args.rollout))
for update in range(1, updates + 1):
    counts = torch.zeros(2, dtype=torch.long, device=device)  # episodes that ended, and those with a collision
    with torch.no_grad():
        for t in range(args.rollout):
            logits = actor(observation)
            gumbel = -torch.log(-torch.log(torch.rand_like(logits).clamp(1e-9, 1.0 - 1e-6)))
            action = torch.argmax(logits + gumbel, dim=1)  # a sample of the softmax
            observations[t], taken[t], before[t], values[t] = observation, action, chosen(logits, action), critic(observation).squeeze(1)
            observation, rewards[t], ends[t], _, info = envs.step(action)
            counts += torch.stack([ends[t].sum().long(), (info["collided"] | info["rear_collided"]).sum()])
        advantages, running = torch.zeros(shape, device=device), torch.zeros(args.envs, device=device)
        following = critic(observation).squeeze(1)
        for t in reversed(range(args.rollout)):  # generalised advantage estimation
            alive = 1.0 - ends[t]
            running = rewards[t] + args.gamma * alive * following - values[t] + args.gamma * args.lam * alive * running
            advantages[t], following = running, values[t]
        returns = advantages + values

    flat = [x.reshape(-1, *x.shape[2:]) for x in (observations, taken, before, advantages, returns)]
    for _ in range(args.epochs):
        for some in torch.randperm(len(flat[0]), device=device).chunk(args.minibatches):
            o, a, old, adv, ret = (x[some] for x in flat)
            ratio = (chosen(actor(o), a) - old).exp()
            adv = (adv - adv.mean()) / (adv.std() + 1e-8)
            surrogate = torch.min(ratio * adv, ratio.clamp(1 - args.clip, 1 + args.clip) * adv).mean()
            loss = 0.5 * (critic(o).squeeze(1) - ret).pow(2).mean() - surrogate
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters()], 0.5)
            optimiser.step()

    ended, crashed = counts.tolist()
    if ended:
        steps = update * args.envs * args.rollout
        rate = steps / (time.perf_counter() - started)
        share = f"collisions in {100 * crashed / ended:5.1f} % of {ended} episodes"
        print(f"{steps / 1e6:6.2f} M steps  {rate / 1e3:5.0f} k steps/s  {share}", flush=True)
envs.close()
