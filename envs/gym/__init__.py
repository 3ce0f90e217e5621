"""The attacker's environments: actions, observations, rewards; Gymnasium, PettingZoo and Stable-Baselines3."""
